"""Animations of a comparison, seen from above: a gif by Matplotlib, and an HTML page."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.output import whole_file
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.replay.comparison import COLOURS, ORIGINAL, Comparison
from safevar_sumo.replay.scene import SEAM_WIDTH, FlatBody, FlatScene, lane_outlines, lay_out_scene

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

WIDTH, PANEL_HEIGHT, DPI = 880, 62, 100
"""Width of a frame, and height of the panel with texts above the road [pixels]; resolution [pixels
per inch].
"""
GROUND_COLOUR, ROAD_COLOUR, SEAM_COLOUR, PATH_COLOUR = "#eef0ec", "#9aa1a9", "#e8eaec", "#cfd3cf"
TEXT_COLOUR, PALE_TEXT_COLOUR, ACTOR_COLOUR = "#1d2329", "#5d666f", "#3f464d"
PERSON_COLOUR, BRAKE_COLOUR, IMPACT_COLOUR = "#1d2329", "#e60000", "#ffd400"
NAME_STYLE: Any = {"color": TEXT_COLOUR, "fontsize": 13, "ha": "center", "va": "center"}
IMPACT_STYLE: Any = {
    "marker": (11, 1, 0),  # a star with 11 points
    "markersize": 50,
    "color": IMPACT_COLOUR,
    "markeredgecolor": TEXT_COLOUR,
}
ENDINGS = (".gif", ".html")
"""Endings of the files that `animate` writes."""
SECONDS_PER_FRAME = 0.1
"""Duration of a gif's frame [s]; gifs resolve 0.01 s."""
LAST_FRAME_DURATION = 2.0
"""Duration of the last frame [s]."""
MAX_GIF_SIZE = 1_000_000
"""Size above which a gif gets fewer frames [bytes]."""
PLAYER_FOLDER = Path(__file__).parent / "web"
WIDTH_IN_TEXT_HEIGHTS = 65
"""Width of a scene [heights of its text]."""
DECIMALS = 2
"""Decimals of a position [m]; a heading has one decimal [degrees]."""


def animate(comparison: Comparison, path: Path) -> None:
    """Write a comparison as an animation in the format of the file's ending; the same comparison
    gives the same bytes.

    Raises
    ------
    InputError
        If the ending is unknown, or the file cannot be written.
    """
    comparison.refuse_without_position()
    ending = path.suffix.lower()
    scene = lay_out_scene(comparison)
    if ending not in ENDINGS:
        raise InputError("animate", str(path), f"a file that ends in {', '.join(ENDINGS)}")
    with whole_file(path, "animate") as file:
        if ending == ".html":
            file.write_text(animation_page(scene), encoding="utf-8", newline="\n")
        else:
            _write_gif(scene, file)


def _write_gif(scene: FlatScene, path: Path) -> None:
    """Write a gif with as many frames as `MAX_GIF_SIZE` allows; the last one stays for a while."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure, show = draw_scene(scene)
    stride = max(1, round(SECONDS_PER_FRAME / scene.step))
    last = scene.sample_count - 1

    # Fewer frames until the file is small enough.
    while True:
        samples = [
            *range(0, last, stride),
            *[last] * (1 + round(LAST_FRAME_DURATION / (stride * scene.step))),
        ]
        animation = FuncAnimation(
            figure, show, samples, init_func=lambda: [], cache_frame_data=False
        )
        animation.save(path, PillowWriter(fps=round(1 / (stride * scene.step))))
        if path.stat().st_size <= MAX_GIF_SIZE or stride > last:
            return
        stride *= 2


def draw_scene(scene: FlatScene) -> tuple[Figure, Callable[[int], list[Patch]]]:
    """Draw a scene as a figure outside any window; also returns the function that shows a sample in
    it.
    """
    from matplotlib.figure import Figure
    from matplotlib.transforms import Affine2D

    # A road that fills the width, and a panel with readings above it.
    height = round(WIDTH * scene.height / scene.width / 2) * 2
    figure = Figure(figsize=(WIDTH / DPI, (PANEL_HEIGHT + height) / DPI), dpi=DPI)
    axis = figure.add_axes(
        (0, 0, 1, height / (PANEL_HEIGHT + height)),
        facecolor=GROUND_COLOUR,
        xticks=[],
        yticks=[],
        ylim=(scene.bottom, scene.bottom + scene.height),
    )
    axis.spines[:].set_visible(False)

    # What is drawn once.
    _draw_road(axis, scene)
    bodies = [(body, *_draw_body(axis, body, scene)) for body in scene.bodies]
    vuts = [body for body in scene.bodies if body.is_vut]
    names = [axis.text(0, 0, scene.comparison.name(body.row), **NAME_STYLE) for body in vuts]
    impacts = [axis.plot([], [], **IMPACT_STYLE)[0] for _ in vuts]
    clock = figure.text(0.014, 0.98, "", fontsize=20, color=TEXT_COLOUR, va="top")
    texts = [
        figure.text(
            0.15,
            1 - (6 + 27 * row) / (PANEL_HEIGHT + height),
            "",
            fontsize=13,
            weight="bold",
            color=COLOURS[row],
            va="top",
            family="monospace",
        )
        for row in scene.comparison.rows
    ]

    def show(sample: int) -> list[Patch]:
        # Every body at its place.
        axis.set_xlim(scene.left_ends[sample], scene.left_ends[sample] + scene.width)
        for body, patches, lights in bodies:
            pose = Affine2D().rotate(body.heading[sample]).translate(body.x[sample], body.y[sample])
            for patch in [*patches, *lights]:
                patch.set_transform(pose + axis.transData)
                is_shown = np.isfinite(body.x[sample]) and (
                    patch not in lights or scene.brakes(body, sample)
                )
                patch.set_visible(bool(is_shown))

        # The name of each vehicle under test, the original's above it and the changed one's below,
        # and at its front bumper the impact that its reading tells.
        for body, name, impact in zip(vuts, names, impacts, strict=True):
            x, y = body.x[sample], body.y[sample]
            side = 1 if body.row == ORIGINAL else -1
            name.set_position((x - body.length / 2, y + side * 0.75 * body.width))
            impact.set_data([x], [y])
            impact.set_visible("collides" in scene.reading(body.row, sample))

        # The time and both readings.
        clock.set_text(f"{sample * scene.step:.2f} s")
        for row, text in enumerate(texts):
            text.set_text(f"{scene.comparison.name(row):8}  {scene.reading(row, sample)}")
        return []  # Matplotlib draws the whole figure again

    return figure, show


def _draw_road(axis: Axes, scene: FlatScene) -> None:
    """Draw lanes, crossings, and a mark every ten metres from the start of the front bumper."""
    from matplotlib.patches import Polygon

    for lane in scene.road:
        layers = [(lane.width, "white" if lane.kind == "crossing" else PATH_COLOUR)]
        if lane.kind == "road":
            layers = [(lane.width, SEAM_COLOUR), (lane.width - SEAM_WIDTH, ROAD_COLOUR)]
        for width, colour in layers:
            for outline in lane_outlines(lane, width):
                axis.add_patch(Polygon(outline, color=colour, linewidth=0))
    for mark in scene.all_marks:
        axis.annotate(
            f" {mark} m",
            (mark, scene.bottom),
            (0, 2),
            textcoords="offset points",
            color=PALE_TEXT_COLOUR,
            fontsize=8,
            annotation_clip=True,
        )
        axis.vlines(mark, scene.bottom, scene.bottom + 0.7, color=PALE_TEXT_COLOUR, linewidth=0.7)


def _draw_body(axis: Axes, body: FlatBody, scene: FlatScene) -> tuple[list[Patch], list[Patch]]:
    """Draw an actor and its brake lights, heading along x; the front bumper, or a person's middle,
    is at the origin.
    """
    from matplotlib.patches import Circle, Rectangle

    # A person is a circle, beside the original vehicle an empty one.
    is_empty = body.row == ORIGINAL and len(scene.comparison.rows) > 1
    length = body.length
    width = body.width
    if body.is_person:
        return [
            axis.add_patch(
                Circle(
                    (0, 0),
                    max(length, width) / 2,
                    facecolor="white" if is_empty else PERSON_COLOUR,
                    edgecolor=PERSON_COLOUR,
                    zorder=3,
                )
            )
        ], []

    # A vehicle is a rectangle; the original one is an outline beneath the other.
    colour = COLOURS[body.row] if body.is_vut else ACTOR_COLOUR
    is_beneath = body.is_vut and is_empty

    def draw(
        x: float,
        y: float,
        length: float,
        width: float,
        zorder: float = 3,
        linewidth: float = 0.0,
        **style: Any,
    ) -> Patch:
        return axis.add_patch(
            Rectangle((x, y), length, width, zorder=zorder, linewidth=linewidth, **style)
        )

    if is_beneath:  # an outline: it is not on the road with the other
        style: dict[str, Any] = {
            "color": colour,
            "fill": False,
            "linewidth": 2.0,
            "linestyle": "--",
        }
        return [draw(-length, -width / 2, length, width, zorder=4, **style)], []

    # Body, windscreen, edge, and brake lights.
    patches = [
        draw(-length, -width / 2, length, width, color=colour, alpha=0.9),
        draw(-0.44 * length, -0.42 * width, 0.16 * length, 0.84 * width, color="white", alpha=0.56),
        draw(
            -length,
            -width / 2,
            length,
            width,
            zorder=4 - body.row,
            linewidth=1.5,
            color=colour,
            fill=False,
        ),
    ]
    sides = (-width / 2, 0.2 * width) if body.is_vut else ()
    return patches, [
        draw(-length, side, 0.28, 0.3 * width, zorder=4, color=BRAKE_COLOUR) for side in sides
    ]


@cache
def player_files() -> dict[str, str]:
    """The style sheet and the script of the player, to include in a page."""
    from markupsafe import Markup

    return {
        name: Markup((PLAYER_FOLDER / f"player.{name}").read_text(encoding="utf-8"))
        for name in ("css", "js")
    }


def template_environment(*folders: Path) -> Environment:
    """The jinja2 environment for templates in these folders and for the player; it escapes all
    values.
    """
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
        title=comparison.title,
        changes=comparison.changes,
        data=player_data(scene),
        **player_files(),
    )


def player_data(scene: FlatScene) -> JsonObject:
    """The data of the template `player`, under `played` those of its script. y points down."""
    # Both drives, and the moments at which something happens.
    comparison = scene.comparison
    trace = scene.comparison.runs.trace
    drives = []
    jumps = []
    for row, (braking_start, nearest, end) in enumerate(comparison.moments):
        name = comparison.name(row)
        samples = slice(0, end + 1)
        ending = "is nearest" if np.isnan(comparison.runs.collision_speed[row]) else "collides"
        moments = ((f"{name} brakes", braking_start), (f"{name} {ending}", nearest))
        jumps += [
            {"name": words, "sample": sample} for words, sample in moments if sample is not None
        ]
        drives.append(
            {
                "name": name,
                "verdict": comparison.verdict(row),
                "end": end,
                "nearest": comparison.moments[row].decided,
                "speed": _rounded_list(trace.speed[samples, row]),
                "gap": _rounded_list(trace.gap[samples, row]),
                "brakes": (trace.brake[samples, row] > 0).astype(int).tolist(),
            }
        )

    # What the picture shows, in words; the road; and all positions over time.
    vehicles = " and ".join(
        f"the {drive['name']} vehicle, which {drive['verdict']}" for drive in drives
    )
    return {
        "description": f"Seen from above after {scene.key_sample * scene.step:.2f} s: {vehicles}",
        "moments": sorted(jumps, key=lambda jump: jump["sample"]),
        "bottom": round(-scene.bottom, DECIMALS),
        "letters": round(scene.width / WIDTH_IN_TEXT_HEIGHTS, DECIMALS),
        "road": [
            {
                "kind": lane.kind,
                "width": round(lane.width, 3),
                "inside": round(lane.width - SEAM_WIDTH, 3),
                "points": " ".join(f"{x:.2f},{-y:.2f}" for x, y in lane.line.tolist()),
            }
            for lane in scene.road
        ],
        "ticks": scene.all_marks,
        "played": {
            "step": scene.step,
            "length": scene.sample_count,
            "key": scene.key_sample,
            "view": {
                "left": _rounded_or_constant(scene.left_ends),
                "top": round(-scene.bottom - scene.height, DECIMALS),
                "width": round(scene.width, DECIMALS),
                "height": round(scene.height, DECIMALS),
            },
            "drives": drives,
            "bodies": [_body_data(body) for body in scene.bodies],
        },
    }


def _body_data(body: FlatBody) -> JsonObject:
    degrees = -np.rad2deg(
        np.unwrap(body.heading) if np.isfinite(body.heading).all() else body.heading
    )
    return {
        "name": body.name,
        "person": body.is_person,
        "length": body.length,
        "width": body.width,
        "drive": body.row if body.is_vut else None,
        "x": _rounded_or_constant(body.x),
        "y": _rounded_or_constant(-body.y),
        "heading": _rounded_or_constant(degrees, decimals=1),
    }


def _rounded_list(values: FloatArray, decimals: int = DECIMALS) -> list[float | None]:
    """Rounded numbers for JSON; null for an undefined number."""
    # + 0.0 turns -0.0 into 0.0
    return [
        round(value, decimals) + 0.0 if np.isfinite(value) else None for value in values.tolist()
    ]


def _rounded_or_constant(
    values: FloatArray, decimals: int = DECIMALS
) -> list[float | None] | float | None:
    """Rounded numbers, or a single number if all are equal."""
    numbers = _rounded_list(values, decimals)
    return numbers[0] if len(set(numbers)) == 1 else numbers
