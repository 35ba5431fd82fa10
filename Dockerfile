# polsep on the CPU:
#   docker build -t polsep .
#   docker run --rm polsep                                  # polsep doctor
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/work" polsep separate shot.png -o out --white-level 4095
FROM python:3.13-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY polsep polsep
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /dist .

FROM python:3.13-slim
RUN --mount=type=bind,from=build,source=/dist,target=/dist \
    --mount=type=bind,source=constraints.txt,target=/constraints.txt \
    pip install --no-cache-dir --no-compile -c /constraints.txt /dist/*.whl
RUN useradd --create-home polsep
USER polsep
WORKDIR /work
ENTRYPOINT ["polsep"]
CMD ["doctor"]
