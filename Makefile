# make demo   set up and separate the embedded capture
# make test   set up and run the suite: lint, types, and all tests whose needs are installed
# make optional  also what optional tests need: the viewer and a browser's driver, Ray, cameras, manifests of napari, OpenImageIO
# make kernels  compile the kernels anew, after a change of them
# make docs   build the documentation site into site/
# make web    build the page that separates in a browser into web/dist; needs node and npm
# make fuzz   damage files of every kind and read them: make fuzz INPUTS=20000 SECONDS=1200
# make faults  kill programs and fill disks: make faults KILLS=100 EVERY=1
# make soak   play a recording in a loop: make soak MINUTES=480
PYTHON ?= python3
VENV ?= .venv
INPUTS ?= 2000
SECONDS ?= 1200
KILLS ?= 100
EVERY ?= 1
MINUTES ?= 480
BIN := $(VENV)/bin
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test optional kernels docs web bench fuzz faults soak clean

demo: $(VENV)/.installed
	$(BIN)/polsep demo -o demo-out

test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n auto --dist loadfile

optional: $(VENV)/.installed-dev
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[view,ray,camera]" npe2 openimageio playwright

kernels: $(VENV)/.installed-dev
	PYTHONHASHSEED=0 nice $(BIN)/python -m tools.build_kernels

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo site/index.html

web: $(VENV)/.installed-dev web/node_modules
	$(BIN)/python -m tools.web_models web/models
	node web/build.mjs web/models polsep/data/still_life.png web/dist

web/node_modules: web/package-lock.json
	npm --prefix web ci --ignore-scripts --no-audit --no-fund --loglevel error
	touch $@

bench: $(VENV)/.installed-dev
	$(BIN)/polsep bench separation

fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m evaluation reliability --inputs $(INPUTS) --seconds $(SECONDS) --keep fuzz-out

faults: $(VENV)/.installed-dev
	$(BIN)/python -m evaluation faults --kills $(KILLS) --every $(EVERY)

soak: $(VENV)/.installed-dev
	$(BIN)/python -m evaluation soak --minutes $(MINUTES)

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev,render,mitsuba,train,bench,export,video,photos]"
	touch $@

$(VENV)/.installed-docs: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

clean:
	rm -rf $(VENV) demo-out fuzz-out site web/dist web/models web/node_modules
