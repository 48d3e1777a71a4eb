"""Results in words that a person reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def measures_of(vessel: Any) -> dict[str, Any]:
    """What tells one vessel from another, in the units a person reads."""
    return {
        "size_mm": [round(1e3 * float(extent), 1) for extent in vessel.extents_m],
        "interior_ml": round(1e6 * vessel.interior_volume_m3),
        "mass_g": round(1e3 * vessel.mass_kg),
        "outlet": vessel.outlet.kind,
        "symmetry": symmetry_in_words(vessel.symmetry.order),
    }


def symmetry_in_words(order: int, axis: str = "z") -> str:
    """Order of a rotational symmetry (0 = continuous, 1 = none) for a reader."""
    return {0: f"about {axis}", 1: "none"}.get(order, f"{order}-fold about {axis}")


def unseen_in_words(time_s: Sequence[float], visible: Sequence[bool]) -> str:
    """When an object was out of view or lost, by the times of the frames and whether each shows it; "" for never."""
    spans: list[list[int]] = []
    for k in (k for k, seen in enumerate(visible) if not seen):
        if spans and spans[-1][1] == k - 1:
            spans[-1][1] = k
        else:
            spans.append([k, k])
    words = []
    for first, last in spans:
        end = "the end" if last == len(visible) - 1 else f"{time_s[last]:.2f} s"
        words.append(f"{time_s[first]:.2f} s to {end}")
    return ", ".join(words)


def as_lines(value: Mapping[str, Any], depth: int = 0) -> list[str]:
    """A nested result as lines of text, one entry a line where it is short."""
    lines = []
    for key, item in value.items():
        name = "  " * depth + key.replace("_", " ")
        if item in ({}, [], None):
            lines.append(f"{name}: none")
        elif isinstance(item, dict) and len(item) < 6 and not any(isinstance(v, (dict, list)) for v in item.values()):
            lines.append(f"{name}: {', '.join(as_lines(item))}")
        elif isinstance(item, dict):
            lines += [name, *as_lines(item, depth + 1)]
        elif isinstance(item, list) and any(isinstance(entry, (str, dict)) for entry in item):
            lines += [name, *("  " * (depth + 1) + str(entry) for entry in item)]
        else:
            lines.append(f"{name}: {f'{item:.4g}' if isinstance(item, float) else item}")
    return lines


def motion_in_words(motion: Mapping[str, Any]) -> str:
    """header["camera"]["motion"] for a reader."""
    if "path_m" in motion:
        return f"moving, over {motion['path_m']:.2f} m, give or take {motion['scale_std']:.1%}"
    return f"{motion['kind']}: {motion['why_not']}" if "why_not" in motion else str(motion["kind"])
