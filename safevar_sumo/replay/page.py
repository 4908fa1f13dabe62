"""A scene as an HTML animation, and the data of its template."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import CHANGED, ORIGINAL
from safevar_sumo.replay.scene import SEAM_WIDTH, FlatBody, FlatScene

if TYPE_CHECKING:
    from jinja2 import Environment

PLAYER_FOLDER = Path(__file__).parent / "web"
WIDTH_IN_TEXT_HEIGHTS = 65
"""Width of a scene [heights of its text]."""
DECIMALS = 2
"""Decimals of a position [m]; a heading has one decimal [degrees]."""


@cache
def player_files() -> dict[str, str]:
    """The style sheet and the script of the player, to include in a page."""
    from markupsafe import Markup

    return {name: Markup((PLAYER_FOLDER / f"player.{name}").read_text(encoding="utf-8")) for name in ("css", "js")}


def template_environment(*folders: Path) -> Environment:
    """The jinja2 environment for templates in these folders and for the player; it escapes all values."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader([*folders, PLAYER_FOLDER]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def animation_page(scene: FlatScene) -> str:
    """A self-contained page that shows one scene."""
    template = template_environment().get_template("animation.html.j2")
    comparison = scene.comparison
    return template.render(
        title=comparison.title, changes=comparison.changes, data=player_data(scene), **player_files()
    )


def player_data(scene: FlatScene) -> dict[str, Any]:
    """The data of the template `player`: the still picture, and under `played` the data of the script. y points
    down.
    """
    view, key_sample = scene.view, scene.key_sample
    drives = [_drive_data(scene, row) for row in scene.comparison.rows]
    bodies = sorted(scene.bodies, key=lambda body: (body.is_vut, body.row))
    left_ends = _rounded_or_constant(view.left_ends)
    box = {
        "left": left_ends,
        "top": round(-view.bottom - view.height, DECIMALS),
        "width": round(view.width, DECIMALS),
        "height": round(view.height, DECIMALS),
    }
    common_data = {"step": scene.step, "length": scene.sample_count, "key": key_sample, "view": box, "drives": drives}
    return {
        **common_data,
        "description": _describe_scene(scene),
        "moments": _list_jumps(scene),
        "bottom": round(-view.bottom, DECIMALS),
        "letters": round(view.width / WIDTH_IN_TEXT_HEIGHTS, DECIMALS),
        "road": [
            _lane_data(lane)
            for kind in ("area", "path", "road", "crossing")
            for lane in scene.road
            if lane.kind == kind
        ],
        "ticks": scene.all_marks,
        "bodies": [_still_body_data(body, scene) for body in bodies],
        "played": {**common_data, "bodies": [_moving_body_data(body) for body in bodies]},
    }


def _describe_scene(scene: FlatScene) -> str:
    """Describe the still picture in words."""
    comparison = scene.comparison
    vehicles = " and ".join(
        f"the {comparison.name(row)} vehicle, which {comparison.verdict(row)}" for row in comparison.rows
    )
    return f"Seen from above after {scene.key_sample * scene.step:.2f} s: {vehicles}"


def _list_jumps(scene: FlatScene) -> list[dict[str, Any]]:
    """The moments that the player's buttons jump to, in order of time."""
    jumps = []
    for row, moments in enumerate(scene.moments):
        name = scene.comparison.name(row)
        if moments.braking_start is not None:
            jumps.append({"name": f"{name} brakes", "sample": moments.braking_start})
        if moments.nearest is not None:
            is_impact = not np.isnan(scene.comparison.film.runs.collision_speed[row])
            jumps.append({"name": f"{name} {'collides' if is_impact else 'is nearest'}", "sample": moments.nearest})
    return sorted(jumps, key=lambda moment: moment["sample"])


def _drive_data(scene: FlatScene, row: int) -> dict[str, Any]:
    trace, moments = scene.comparison.film.runs.trace, scene.moments[row]
    samples = slice(0, moments.end + 1)
    return {
        "name": scene.comparison.name(row),
        "verdict": scene.comparison.verdict(row),
        "end": moments.end,
        "nearest": moments.end if moments.nearest is None else moments.nearest,
        "speed": _rounded_list(trace.speed[samples, row]),
        "gap": _rounded_list(trace.gap[samples, row]),
        "brakes": (trace.brake[samples, row] > 0).astype(int).tolist(),
    }


def _lane_data(lane: Any) -> dict[str, Any]:
    return {
        "kind": lane.kind,
        "width": round(lane.width, 3),
        "inside": round(lane.width - SEAM_WIDTH, 3),
        "points": " ".join(f"{x:.2f},{-y:.2f}" for x, y in lane.line.tolist()),
    }


def _moving_body_data(body: FlatBody) -> dict[str, Any]:
    degrees = -np.rad2deg(np.unwrap(body.heading)) if np.isfinite(body.heading).all() else -np.rad2deg(body.heading)
    return {
        "drive": body.row if body.is_vut else None,
        "x": _rounded_or_constant(body.x),
        "y": _rounded_or_constant(-body.y),
        "heading": _rounded_or_constant(degrees, decimals=1),
    }


def _still_body_data(body: FlatBody, scene: FlatScene) -> dict[str, Any]:
    """One body at the key sample."""
    key_sample = scene.key_sample
    x, y, heading = (
        _rounded_list(values[key_sample : key_sample + 1])[0] for values in (body.x, -body.y, -np.rad2deg(body.heading))
    )
    style = {ORIGINAL: "original", CHANGED: "changed"}[body.row] if body.is_vut else "other"
    brake = scene.comparison.film.runs.trace.brake[min(key_sample, scene.moments[body.row].end), body.row]
    return {
        "name": body.name,
        "person": body.is_person,
        "length": body.length,
        "width": body.width,
        "look": style,
        "title": f"{scene.comparison.name(body.row)} vehicle" if body.is_vut else body.name,
        "radius": max(body.length, body.width) / 2,
        "drive": body.row if body.is_vut else None,
        "brakes_key": body.is_vut and brake > 0,
        "x_key": x,
        "y_key": y,
        "heading_key": heading,
    }


def _rounded_list(values: FloatArray, decimals: int = DECIMALS) -> list[float | None]:
    """Rounded numbers for JSON; null for an undefined number."""
    return [round(value, decimals) + 0.0 if np.isfinite(value) else None for value in values.tolist()]


def _rounded_or_constant(values: FloatArray, decimals: int = DECIMALS) -> list[float | None] | float | None:
    """Rounded numbers, or a single number if all are equal."""
    numbers = _rounded_list(values, decimals)
    return numbers[0] if len(set(numbers)) == 1 else numbers
