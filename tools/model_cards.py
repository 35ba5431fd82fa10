"""``python -m tools.model_cards``: write a card beside each file of weights that ships: data, training, scores, limits.

Facts are those of the file, scores those of results/: cards are made anew after either changes, and
`tests/test_release.py` fails until then.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from polsep.io.store.atomic import replace_text
from polsep.io.store.rows import markdown_table, read_rows
from polsep.io.store.weights import read_weights

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS, RESULTS = ROOT / "polsep" / "weights", ROOT / "results"


class Kind(NamedTuple):
    """Facts that the weights of one method share: use, data, limits, and what part of the results is of them."""

    use: str
    data: str
    limits: str
    results: str
    bench: str


_RENDERED = (
    "Random textured shapes, rendered while it was trained, as a model of Sony's IMX250 records them "
    "(docs/training.md, docs/dataset.md). No photographs, no scans, no data of others."
)
_ONE_LAMP = (
    "One lamp behind one linear polarizer, a dark room, dielectric surfaces; the lamp's colour is divided out before. "
    "Two lamps, unpolarized light, metals and inter-reflections: see Limits in README.md and docs/reality.md. It was "
    "trained on rendered frames alone, and scores on photographs are few."
)
_KINDS = {
    "joint": Kind(
        "One raw mosaic to diffuse and specular image and their expected errors, at half and full resolution.",
        _RENDERED,
        _ONE_LAMP,
        "sets",
        "sets/noisy",
    ),
    "paper": Kind(
        "The paper's two U-Nets, which refine the analytic split: for comparison.",
        _RENDERED,
        _ONE_LAMP + " Diffuse and specular do not sum to the light that was measured.",
        "sets",
        "sets/noisy",
    ),
    "material": Kind(
        "Normals, diffuse colour, roughness and specular reflectance of a flat sample, from one or more flash frames.",
        "Procedural materials, rendered under a flash while it was trained (docs/material.md). No photographs.",
        "Flat samples that fill the frame, lit by a flash beside the lens (docs/material.md).",
        "material",
        "material/relit",
    ),
    "shape": Kind(
        "Normals, albedo, roughness and specular strength of an object, and their expected errors, from one "
        "separated frame.",
        "Unions of solids, smooth bodies and vessels with random textures, rendered as a model of Sony's IMX250 "
        "records them, and separated by this package (docs/shape.md), and 367 meshes from packages under free licences "
        "(evaluation/weights/shape/meshes.tsv). No photographs; some bones and asteroids are scans.",
        "One dielectric object under one polarized lamp within some 45 degrees of the camera; detail below a "
        "hundredth of the object is lost or faint (docs/shape.md).",
        "shape",
        "shape/normals",
    ),
}


def write_card(weights: Path) -> str:
    """The text of the card of a file of weights."""
    _, facts = read_weights(weights)
    name = weights.relative_to(WEIGHTS).with_suffix("").as_posix()
    kind = _KINDS[facts["method"].partition("-")[0]]
    return "\n".join([f"# {name}", "", kind.use, "", *_facts(weights, facts), "", *_sections(name, kind, facts)]) + "\n"


def _facts(weights: Path, facts: dict[str, str]) -> Iterator[str]:
    """Lines of a table of the file's facts."""
    yield "| what | |\n|---|---|"
    yield f"| method | `{facts['method']}`, {facts.get('variant', facts.get('input'))} |"
    yield f"| size | {facts['size'].replace('|', '/')}, {weights.stat().st_size / 1e6:.2f} MB |"
    yield f"| sha256 of the arrays | `{facts['sha256']}` |"
    if "rounded_from" in facts:
        yield f"| before large layers were rounded to 8 bits | `{facts['rounded_from']}` |"
    if "error_factors" in facts:
        factors = " and ".join(map(str, json.loads(facts["error_factors"])))
        yield f"| expected errors of diffuse and of specular, after training times | {factors} |"
    yield "| licence | MIT, as polsep |"


def _sections(name: str, kind: Kind, facts: dict[str, str]) -> Iterator[str]:
    """Lines of the card below its facts."""
    yield f"## Data\n\n{kind.data}\n\n## Training\n"
    if "command" in facts:
        yield f"Last stage: `{facts['command']}`.\n"
    yield "docs/weights.md has all stages, a recipe to train it again, and what cannot be made again.\n\n## Scores\n"
    if "validation" in facts:
        scores = ", ".join(f"{metric} {value:.4g}" for metric, value in json.loads(facts["validation"]).items())
        yield f"On its own validation views, which chose it, before rounding: {scores}.\n"
    method = Path(name).name if kind.results in ("material", "shape") else facts["method"]
    colors = facts.get("variant") != "mono"
    bench = kind.bench if colors else "joint/mono"
    rows = [row for row in read_rows(RESULTS / f"{bench.partition('/')[0]}.jsonl") if row["bench"] == bench]
    rows = [row for row in rows if row["method"] == method and _is_main(row["metric"])]
    yield markdown_table(rows) if rows else "Not scored by itself.\n"
    yield f"## Limits\n\n{kind.limits}"


def _is_main(metric: str) -> bool:
    return metric.removesuffix(", standard error").endswith("PSNR") or any(
        word in metric for word in ("relit", "loss", "angular")
    )


def main() -> None:
    """Write all cards."""
    for weights in sorted(WEIGHTS.rglob("*.safetensors")):
        replace_text(weights.with_suffix(".md"), write_card(weights))
        print(weights.with_suffix(".md").relative_to(ROOT))


if __name__ == "__main__":
    main()
