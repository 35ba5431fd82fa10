"""One line of what matters in a report."""

from __future__ import annotations

from typing import Any


def summary(report: dict[str, Any]) -> str:
    """Method, clipping, the light, expected errors and the number of warnings, in one line."""
    from polsep.physics.stokes import axis_deg
    from polsep.separation.report import PICTURE, angle_origin

    facts, light = report["statistics"], report.get("light", {})
    parts = [report["method"], f"{_percent(facts['clipped_fraction'])} clipped"]
    known = angle_origin(report) == PICTURE  # else 0 deg lies nobody knows where
    seen = [f"polarizer at {axis_deg(facts['light_polarizer_deg']):.0f} deg"] if known else []
    seen += [] if len(report["light_color"]) == 1 else [_color(light)]
    parts += [f"light: {', '.join(seen)}"] if seen else []
    if "expected_diffuse_error_median" in facts:
        errors = [facts[f"expected_{image}_error_median"] for image in ("diffuse", "specular")]
        parts.append("median expected error: diffuse {:.2g}, specular {:.2g}".format(*errors))
    count = len(report["warnings"])
    return "; ".join([*parts, f"{count} warning{'s' * (count != 1)}" if count else "no warnings"])


def _color(light: dict[str, Any]) -> str:
    """The light's colour and where it is from."""
    color = ",".join(f"{c:.2f}" for c in light["color"])
    error, source = light.get("error_deg"), light["source"]
    if error is None:
        return f"colour {color} ({source})"
    source = source if light.get("sure", True) else "assumed"
    return f"colour {color} ({source}, colour error {'below 0.1' if error < 0.1 else f'{error:.1f}'} deg)"


def _percent(share: float) -> str:
    """A share in percent; a few pixels never read as none."""
    return "nothing" if share == 0 else f"{share:.2%}" if share >= 1e-4 else "below 0.01%"
