"""Animations of a comparison from above, drawn by Matplotlib: as a gif, or as an HTML page."""

from __future__ import annotations

import re
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from markupsafe import Markup, escape

from safevar_sumo.errors import InputError, printable
from safevar_sumo.output import whole_file
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.figures import own_style
from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import COLOURS, ORIGINAL, Comparison
from safevar_sumo.scenarios import VUT

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.transforms import Affine2D

FRAME_WIDTH = 8.8
"""Width of a frame [inches]."""
PANEL_HEIGHT = 0.62
"""Height of the panel with texts above the road [inches]."""
FRAME_DPI = 100
"""Resolution of an animation [pixels per inch]."""
PAGE_DPI = 75
"""Resolution of an animation on a page with other animations [pixels per inch]."""
MAX_FRAMES = 100
"""Largest number of frames of an animation."""
MAX_PAGE_FRAMES = 40
"""Largest number of frames of an animation on a page with other animations."""
PALETTE = 32
"""Number of colours to which the frames of a player are reduced."""
GROUND_COLOUR = "#eef0ec"
TEXT_COLOUR = "#1d2329"
PALE_TEXT_COLOUR = "#5d666f"
ACTOR_COLOUR = "#3f464d"
IMPACT_COLOUR = "#ffd400"
SEAM_WIDTH = 0.12
"""Width of the line between two lanes [m]."""
LAYERS = {
    "path": [(0.0, "#cfd3cf")],
    "road": [(0.0, "#e8eaec"), (SEAM_WIDTH, "#9aa1a9")],
    "crossing": [(0.0, "white")],
}
"""Lines that draw a lane, one upon the other, by kind of lane: the difference between the widths of
lane and line [m], and the line's colour.
"""
KINDS = ("area", *LAYERS)
"""Kinds of lanes in the order in which they are drawn."""
STRIPE_LENGTH = 0.5
"""Length of a crossing's stripes, and of the space between them [m]."""
IMPACT_STYLE: Any = {
    # A star with 11 points.
    "marker": (11, 1, 0),
    "markersize": 50,
    "color": IMPACT_COLOUR,
    "markeredgecolor": TEXT_COLOUR,
}
FREE_SPACE = 4.0
"""Free space around the actors [m]."""
MIN_HEIGHT = 11.0
"""Smallest height of a view [m]."""
MAX_ROAD_LENGTH = 60.0
"""Largest length of road in a view [m]: in a longer scene a camera follows the vehicles."""
CAMERA_LEAD = 0.45
"""Share of the view's length behind the front bumpers of the vehicles under test [-]."""
MAX_DISTANCE = 30.0
"""Distance to the vehicle under test beyond which actors are not shown [m]."""
ENDINGS = (".gif", ".html")
"""Endings of the files that `animate` writes."""
SECONDS_PER_FRAME = 0.1
"""Least duration of a frame [s]; gifs resolve 0.01 s."""
LAST_FRAME_DURATION = 2.0
"""Time for which a gif shows its last frame [s]."""
PLAYER_FOLDER = Path(__file__).parent / "web"
HTML_CHANGES = {
    r"\\\n": "",
    # Icons from the net, which `player.css` has, too.
    r'<link rel="stylesheet"[^>]*>': "",
    r"this\.current_frame = 0;": "this.current_frame = frames.length - 1;",
    r'name="points"': 'aria-label="time"',
}
"""Replacements in the HTML that Matplotlib writes, by regular expression. With them a page opens
offline, shows first how a drive ends, and names its controls for screen readers.
"""


class DrawnBody(NamedTuple):
    """An actor in one of the two simulations (`row`), at T samples: the position of a vehicle's
    front bumper or of a person's middle, x to the right and y up, shape (T,) [m], and the heading
    counter-clockwise from x, shape (T,) [rad].
    """

    row: int
    is_vut: bool
    is_person: bool
    length: float
    width: float
    x: FloatArray
    y: FloatArray
    heading: FloatArray


@checked
@own_style()
def animate(comparison: Comparison, path: str | Path) -> None:
    """Write a comparison as an animation in the format of the file's ending; the same comparison
    gives the same bytes.

    Raises
    ------
    InputError
        If the ending is unknown, or the file cannot be written.
    """
    from matplotlib.animation import PillowWriter

    comparison.refuse_without_position()
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(
            "animate", str(path), f"a file that ends in {', '.join(ENDINGS)}"
        )
    with whole_file(path, "animate") as file:
        if ending == ".gif":
            film, fps = film_of(comparison, MAX_FRAMES, LAST_FRAME_DURATION)
            film.save(file, PillowWriter(fps), dpi=FRAME_DPI)  # type: ignore[arg-type]
            return
        page = template_environment().get_template("animation.html.j2")
        text = page.render(
            title=comparison.title,
            changes=comparison.changes,
            player=player_of(comparison, 1, MAX_FRAMES, FRAME_DPI),
        )
        file.write_text(printable(text), encoding="utf-8", newline="\n")


@own_style()
def player_of(
    comparison: Comparison,
    number: int,
    frames: int = MAX_PAGE_FRAMES,
    dpi: int = PAGE_DPI,
) -> Markup:
    """HTML that plays a comparison, without other files. `number` makes its names unique on a page.
    Without JavaScript it shows the last frame.
    """
    from matplotlib.animation import HTMLWriter

    film, fps = film_of(comparison, frames)
    with TemporaryDirectory() as folder:
        file = Path(folder, "player.html")
        writer = HTMLWriter(fps, embed_frames=True)  # type: ignore[arg-type]
        film.save(file, writer, dpi=dpi)
        html = file.read_text(encoding="utf-8")
    for pattern, text in HTML_CHANGES.items():
        html = re.sub(pattern, text, html)

    html = re.sub(r'(?<=base64,)[^"]*', _with_palette, html)

    # Matplotlib gives a player a random name.
    (name,) = set(re.findall(r"_anim_img(\w+)", html))
    frame = re.findall(r'"(data:image[^"]*)"', html)[-1]
    verdicts = (
        f"{comparison.name(row)} {comparison.verdict(row)}" for row in comparison.rows
    )
    words = escape(f"Seen from above: {', '.join(verdicts)}")
    html = html.replace("<img", f'<img alt="{words}" src="{frame}"', 1)
    return Markup(html.replace(name, str(number)))


def _with_palette(picture: re.Match[str]) -> str:
    """The data of a picture with a palette of colours, which are a quarter as long."""
    from PIL import Image

    data = BytesIO()
    with Image.open(BytesIO(b64decode(picture[0]))) as image:
        image.convert("RGB").quantize(PALETTE).save(data, "png")
    return b64encode(data.getvalue()).decode()


def film_of(
    comparison: Comparison, frames: int, pause: float = 0.0
) -> tuple[FuncAnimation, float]:
    """An animation with about `frames` frames at most, and its number of frames per second. The
    last frame stays for the time `pause` [s].
    """
    from matplotlib.animation import FuncAnimation

    step = comparison.runs.trace.step
    end = comparison.last_sample
    stride = max(round(SECONDS_PER_FRAME / step), -(-end // frames), 1)
    fps = 1 / (stride * step)
    samples = [*range(0, end, stride), *[end] * round(1 + pause * fps)]
    figure, show = draw_scene(comparison)
    film = FuncAnimation(figure, show, samples, init_func=list, cache_frame_data=False)
    return film, fps


def draw_scene(comparison: Comparison) -> tuple[Figure, Callable[[int], list[Patch]]]:
    """Draw the scene of a comparison as a figure outside any window. Returns the figure, and a
    function that shows a sample in this figure.
    """
    from matplotlib.figure import Figure
    from matplotlib.transforms import Affine2D

    bodies, turn = lay_out(comparison)
    left_ends, width, bottom, top = _choose_view(bodies)
    height = FRAME_WIDTH * (top - bottom) / width
    full_height = PANEL_HEIGHT + height
    figure = Figure(figsize=(FRAME_WIDTH, full_height))
    axis = figure.add_axes(
        (0, 0, 1, height / full_height),
        facecolor=GROUND_COLOUR,
        yticks=[],
        ylim=(bottom, top),
    )
    axis.spines[:].set_visible(False)
    _draw_road(axis, comparison, turn, points=72 * FRAME_WIDTH / width)

    is_pair = len(comparison.rows) > 1
    patches = [
        axis.add_patch(_draw_body(body, is_outline=is_pair and body.row == ORIGINAL))
        for body in bodies
    ]
    impacts = [axis.plot([], [], **IMPACT_STYLE)[0] for _ in comparison.rows]
    clock = figure.text(
        0.014, 1 - 0.12 / full_height, "", fontsize=15, color=TEXT_COLOUR, va="top"
    )
    style: Any = {"fontsize": 9.5, "weight": "bold", "va": "top", "family": "monospace"}
    texts = [
        figure.text(
            0.12, 1 - (0.12 + 0.23 * row) / full_height, "", color=COLOURS[row], **style
        )
        for row in comparison.rows
    ]

    def show(sample: int) -> list[Patch]:
        """Show a sample: move the view and the bodies, and write the texts."""
        axis.set_xlim(left_ends[sample], left_ends[sample] + width)
        for body, patch in zip(bodies, patches, strict=True):
            x = body.x[sample]
            y = body.y[sample]
            pose = Affine2D().rotate(body.heading[sample]).translate(x, y)
            patch.set_transform(pose + axis.transData)
            patch.set_visible(bool(np.isfinite(x)))
            if body.is_vut:
                impacts[body.row].set_data([x], [y])

        clock.set_text(f"{sample * comparison.runs.trace.step:.2f} s")
        for row, moments in enumerate(comparison.moments):
            texts[row].set_text(reading(comparison, row, sample))
            has_collided = not np.isnan(comparison.runs.closing_speed[row])
            impacts[row].set_visible(has_collided and sample >= moments.decided)
        # An empty list makes Matplotlib draw the whole figure again.
        return []

    return figure, show


def lay_out(comparison: Comparison) -> tuple[list[DrawnBody], Affine2D]:
    """The actors that ever come near the vehicle under test, and the transformation that turns the
    scene: then this vehicle starts at the origin, and heads to the right.
    """
    from matplotlib.transforms import Affine2D

    vut = comparison.tracks[VUT]
    heading = vut.heading[0, 0]
    turn = Affine2D().translate(*-vut.motion[0, 0, :2]).rotate(-heading)
    bodies = []
    rows = enumerate(comparison.moments)
    for (name, track), (row, moments) in product(comparison.tracks.items(), rows):
        # After the end of a run its actors stay in place, because their samples are meaningless.
        samples = np.minimum(np.arange(comparison.last_sample + 1), moments.end)
        place = track.motion[samples, row, :2]
        distance = np.linalg.norm(place - vut.motion[samples, row, :2], axis=1)
        if np.any(distance < MAX_DISTANCE + track.length):
            x, y = turn.transform(place).T
            bodies.append(
                DrawnBody(
                    row,
                    name == VUT,
                    track.is_person,
                    track.length,
                    track.width,
                    x,
                    y,
                    track.heading[samples, row] - heading,
                )
            )
    return bodies, turn


def _choose_view(bodies: Sequence[DrawnBody]) -> tuple[FloatArray, float, float, float]:
    """The view: its left end at each sample, shape (T,), its length, and its lower and its upper
    end [m].
    """
    x, y = np.stack([(body.x, body.y) for body in bodies], axis=1)
    sizes = np.array([(body.length, body.width / 2) for body in bodies])
    length, half_width = sizes.T[:, :, np.newaxis]
    rear = np.nanmin(x - length) - FREE_SPACE
    front = np.nanmax(x + length) + FREE_SPACE
    bottom = np.nanmin(y - half_width) - FREE_SPACE
    top = np.nanmax(y + half_width) + FREE_SPACE
    padding = max(0.0, MIN_HEIGHT - (top - bottom)) / 2

    # A camera follows the vehicles where a view of all bodies is too long.
    width = min(front - rear, MAX_ROAD_LENGTH)
    fronts = np.mean([body.x for body in bodies if body.is_vut], axis=0)
    left_ends = np.clip(fronts - CAMERA_LEAD * width, rear, front - width)
    return left_ends, width, bottom - padding, top + padding


def _draw_road(
    axis: Axes, comparison: Comparison, turn: Affine2D, points: float
) -> None:
    """Draw the lanes, and a mark every ten metres from the front bumper's start. A metre has
    `points` points of a line's width.
    """
    from matplotlib.patches import Polygon
    from matplotlib.ticker import MultipleLocator

    transform = turn + axis.transData
    for lane in sorted(comparison.road, key=lambda lane: KINDS.index(lane.kind)):
        if lane.kind == "area":
            colour = LAYERS["path"][0][1]
            axis.add_patch(
                Polygon(lane.line, linewidth=0, color=colour, transform=transform)
            )
            continue
        stripes = STRIPE_LENGTH / lane.width
        style: Any = {
            "linestyle": (0, (stripes, stripes)) if lane.kind == "crossing" else "-"
        }
        for reduction, colour in LAYERS[lane.kind]:
            style |= {"linewidth": (lane.width - reduction) * points, "color": colour}
            axis.plot(*lane.line.T, solid_capstyle="butt", transform=transform, **style)
    axis.xaxis.set_major_locator(MultipleLocator(10))
    axis.xaxis.set_major_formatter("{x:.0f} m")
    axis.tick_params(
        axis="x", direction="in", pad=-15, labelsize=8, colors=PALE_TEXT_COLOUR
    )


def _draw_body(body: DrawnBody, *, is_outline: bool) -> Patch:
    """The shape of an actor that heads along x, with its front bumper, or a person's middle, at the
    origin. An outline has no filling.
    """
    from matplotlib.patches import Circle, Polygon

    colour = COLOURS[body.row] if body.is_vut else ACTOR_COLOUR
    style: Any = {"color": colour, "zorder": 3}
    if is_outline:
        # The two vehicles are not on the road together: the original shines through the other.
        style |= {
            "fill": False,
            "linewidth": 2,
            "linestyle": "--",
            "zorder": 4 if body.is_vut else 2,
        }
    if body.is_person:
        return Circle((0, 0), max(body.length, body.width) / 2, **style)
    side = body.width / 2
    corners = [(-body.length, side), (-side / 2, side), (0, side / 2)]
    return Polygon([*corners, *[(x, -y) for x, y in reversed(corners)]], **style)


def reading(comparison: Comparison, row: int, sample: int) -> str:
    """A line of text on a vehicle at a sample: its speed, its gap, whether it brakes and, from the
    nearest moment on, how its run ends.
    """
    trace = comparison.runs.trace
    moments = comparison.moments[row]
    index = min(sample, moments.end)
    ending = ""
    if trace.brake[index, row] > 0:
        ending = "brakes"
    if sample >= moments.decided:
        ending = comparison.verdict(row)
    gap = trace.gap[index, row]
    words = ""
    if np.isfinite(gap):
        words = f"gap {max(gap, 0):.1f} m"
    return f"{comparison.name(row):8}  {trace.speed[index, row]:4.1f} m/s  {words:10}  {ending}"


def template_environment(*folders: Path) -> Environment:
    """The jinja2 environment for templates in these folders and in the folder of the player. It
    escapes all values.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader([*folders, PLAYER_FOLDER]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
