"""Animations of a comparison as gif, mp4 or HTML page, and the frames of gif and mp4."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.output import whole_file
from safevar_sumo.records import FloatArray
from safevar_sumo.replay.comparison import CHANGED, ORIGINAL, Comparison
from safevar_sumo.replay.film import LaneLine
from safevar_sumo.replay.scene import SEAM_WIDTH, FlatBody, FlatScene, lay_out_scene

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

PixelPoints = list[tuple[float, float]]

WIDTH = 880
"""Width of a frame [pixels]."""
OVERSAMPLING = 2
"""Factor by which frames are drawn larger and then reduced, for smooth edges."""
TEXT_COLUMNS = (164, 250, 340, 450)
"""Left edges of the columns of texts [pixels]."""
PANEL_HEIGHT = 62
"""Height of the panel with texts above the road [pixels]."""
GROUND_COLOUR, ROAD_COLOUR, SEAM_COLOUR, PATH_COLOUR = "#eef0ec", "#9aa1a9", "#e8eaec", "#cfd3cf"
WHITE, TEXT_COLOUR, PALE_TEXT_COLOUR = "#ffffff", "#1d2329", "#5d666f"
VEHICLE_COLOURS = {ORIGINAL: "#0072b2", CHANGED: "#d55e00"}
ACTOR_COLOUR, PERSON_COLOUR, BRAKE_COLOUR = "#3f464d", "#1d2329", "#e60000"
STRIPE_LENGTH = 0.5
"""Length of a crossing's stripes, and of the space between them [m]."""


def draw_frames(scene: FlatScene, stride: int) -> Iterator[Image]:
    """Draw every `stride`-th sample of a scene, and the last one."""
    canvas = _Canvas(scene)
    for sample in [*range(0, scene.sample_count - 1, stride), scene.sample_count - 1]:
        yield canvas.picture(sample)


class _Canvas:
    """Draws the samples of one scene."""

    def __init__(self, scene: FlatScene) -> None:
        self._scene, self._scale = scene, OVERSAMPLING * WIDTH / scene.view.width
        height = round(self._scale * scene.view.height / 2 / OVERSAMPLING) * 2 * OVERSAMPLING
        self._size = (OVERSAMPLING * WIDTH, OVERSAMPLING * PANEL_HEIGHT + height)

    def picture(self, sample: int) -> Image:
        from PIL import Image, ImageDraw

        image = Image.new("RGB", self._size, GROUND_COLOUR)
        draw = ImageDraw.Draw(image, "RGBA")
        for kind in ("area", "path", "road", "crossing"):
            for lane in self._scene.road:
                if lane.kind == kind:
                    self._draw_lane(draw, lane, sample)
        visible_bodies = [body for body in self._scene.bodies if not np.isnan(body.x[sample])]
        for body in sorted(visible_bodies, key=lambda body: (body.is_vut, body.row)):
            self._draw_body(draw, body, sample)
        for body in visible_bodies:
            if body.is_vut and body.row == ORIGINAL:  # draw its outline again, over a changed vehicle that hides it
                draw.polygon(self._pixels(body.corners(sample), sample), outline=VEHICLE_COLOURS[ORIGINAL], width=2 * OVERSAMPLING)
        self._draw_scale_marks(draw, sample)
        draw.rectangle((0, 0, self._size[0], OVERSAMPLING * PANEL_HEIGHT), fill=WHITE)
        self._draw_texts(draw, sample)
        return image.resize((WIDTH, self._size[1] // OVERSAMPLING), Image.Resampling.BOX)

    def _pixels(self, points: FloatArray, sample: int) -> PixelPoints:
        view = self._scene.view
        grid = OVERSAMPLING / self._scale  # the camera moves by whole pixels, so that the road stays sharp
        x, y = points[:, 0] - np.round(view.left_ends[sample] / grid) * grid, points[:, 1] - view.bottom
        return list(zip((x * self._scale).tolist(), (self._size[1] - y * self._scale).tolist(), strict=True))

    def _draw_scale_marks(self, draw: ImageDraw, sample: int) -> None:
        """Draw a mark every ten metres from the start of the front bumper."""
        view = self._scene.view
        for mark in self._scene.marks(sample):
            (x, y), = self._pixels(np.array([[mark, view.bottom]]), sample)
            draw.line((x, y - 12 * OVERSAMPLING, x, y), fill=PALE_TEXT_COLOUR, width=OVERSAMPLING)
            self._draw_text(draw, (round(x / OVERSAMPLING) + 4, round(y / OVERSAMPLING) - 16), f"{mark:g} m", PALE_TEXT_COLOUR, 12)

    def _draw_lane(self, draw: ImageDraw, lane: LaneLine, sample: int) -> None:
        if lane.kind == "area":
            draw.polygon(self._pixels(lane.line, sample), fill=PATH_COLOUR)
            return
        if lane.kind == "crossing":
            for stripe in crossing_stripes(lane):
                draw.polygon(self._pixels(stripe, sample), fill=WHITE)
            return
        self._draw_strip(draw, lane.line, lane.width, SEAM_COLOUR if lane.kind == "road" else PATH_COLOUR, sample)
        if lane.kind == "road":
            self._draw_strip(draw, lane.line, lane.width - SEAM_WIDTH, ROAD_COLOUR, sample)

    def _draw_strip(self, draw: ImageDraw, line: FloatArray, width: float, colour: str, sample: int) -> None:
        for start, end in pairwise(line):
            draw.polygon(self._pixels(strip_corners(start, end, width), sample), fill=colour)

    def _draw_body(self, draw: ImageDraw, body: FlatBody, sample: int) -> None:
        if body.is_person:
            radius = max(body.length, body.width) / 2 * self._scale
            (x, y), = self._pixels(np.array([[body.x[sample], body.y[sample]]]), sample)
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=PERSON_COLOUR, outline=WHITE, width=OVERSAMPLING)
            return
        colour = VEHICLE_COLOURS[body.row] if body.is_vut else ACTOR_COLOUR
        corners = body.corners(sample)
        opacity = "99" if body.is_vut and body.row == ORIGINAL and len(self._scene.moments) > 1 else "e6"
        draw.polygon(self._pixels(corners, sample), fill=colour + opacity, outline=colour, width=2 * OVERSAMPLING)
        window_front = corners[[0, 1]] * [[0.72], [0.72]] + corners[[3, 2]] * 0.28
        window_rear = corners[[0, 1]] * 0.56 + corners[[3, 2]] * 0.44
        draw.polygon(self._pixels(np.concatenate([window_front, window_rear[::-1]]), sample), fill="#ffffff90")
        if body.is_vut and self._is_braking(body.row, sample):
            for corner, opposite_corner in ((3, 2), (2, 3)):
                rear_side = corners[opposite_corner] - corners[corner]
                light = np.array([corners[corner], corners[corner] + 0.3 * rear_side])
                forward = (corners[0] - corners[3]) / body.length * 0.28
                draw.polygon(self._pixels(np.concatenate([light, light[::-1] + forward]), sample), fill=BRAKE_COLOUR)

    def _is_braking(self, row: int, sample: int) -> bool:
        trace = self._scene.comparison.film.runs.trace
        return bool(trace.brake[min(sample, self._scene.moments[row].end), row] > 0)

    def _draw_texts(self, draw: ImageDraw, sample: int) -> None:
        """Draw the time and, for each vehicle, its speed, its gap and, at the end, its outcome."""
        trace = self._scene.comparison.film.runs.trace
        self._draw_text(draw, (12, 14), f"{sample * self._scene.step:.2f} s", TEXT_COLOUR, 26)
        for row in self._scene.comparison.rows:
            moments = self._scene.moments[row]
            run_sample = min(sample, moments.end)
            gap = trace.gap[run_sample, row]
            is_finished = sample >= (moments.end if moments.nearest is None else moments.nearest)
            ending = self._scene.comparison.verdict(row) if is_finished else "brakes" if self._is_braking(row, run_sample) else ""
            y = 8 + 26 * row
            swatch = (OVERSAMPLING * 132, OVERSAMPLING * (y + 3), OVERSAMPLING * 154, OVERSAMPLING * (y + 17))
            draw.rectangle(swatch, fill=VEHICLE_COLOURS[row])
            gap_text = f"gap {max(gap, 0):.1f} m" if np.isfinite(gap) else ""
            texts = (self._scene.comparison.name(row), f"{trace.speed[run_sample, row]:.1f} m/s", gap_text, ending)
            for x, text in zip(TEXT_COLUMNS, texts, strict=True):
                self._draw_text(draw, (x, y), text, TEXT_COLOUR, 17)

    def _draw_text(self, draw: ImageDraw, position: tuple[int, int], text: str, colour: str, size: int) -> None:
        from PIL import ImageFont

        x, y = position
        draw.text((OVERSAMPLING * x, OVERSAMPLING * y), text, fill=colour, font=ImageFont.load_default(OVERSAMPLING * size))


def strip_corners(start: FloatArray, end: FloatArray, width: float) -> FloatArray:
    """The corners of a straight strip from start to end, shape (4, 2)."""
    direction = end - start
    half_width = np.array([-direction[1], direction[0]]) / (np.hypot(*direction) or 1.0) * width / 2
    return np.array([start + half_width, end + half_width, end - half_width, start - half_width])


def crossing_stripes(lane: LaneLine) -> Iterator[FloatArray]:
    """The stripes of a crossing, each of shape (4, 2)."""
    for start, end in pairwise(lane.line):
        direction = (end - start) / (np.hypot(*(end - start)) or 1.0)
        for distance in np.arange(STRIPE_LENGTH / 2, np.hypot(*(end - start)) - STRIPE_LENGTH, 2 * STRIPE_LENGTH):
            yield strip_corners(start + direction * distance, start + direction * (distance + STRIPE_LENGTH), lane.width)


SECONDS_PER_FRAME = 0.1
"""Duration of a gif's frame [s]; gifs resolve 0.01 s."""
LAST_FRAME_DURATION = 2.0
"""Duration of the last frame [s]."""
PALETTE_SIZE = 64
"""Number of colours of a gif."""
MAX_GIF_SIZE = 1_000_000
"""Size above which a gif gets fewer frames [bytes]."""


def animate(comparison: Comparison, path: Path) -> None:
    """Write a comparison as an animation in the format of the file's ending; the same comparison gives the same bytes.

    Raises
    ------
    InputError
        If the ending is unknown, the file cannot be written, or an mp4 cannot be encoded because ffmpeg is missing.
    """
    ending = path.suffix.lower()
    if ending not in ANIMATION_WRITERS:
        raise InputError("animate", str(path), f"a file that ends in {', '.join(ANIMATION_WRITERS)}")
    with whole_file(path, "animate") as file:
        ANIMATION_WRITERS[ending](lay_out_scene(comparison), file)


def require_ffmpeg(path: Path) -> None:
    """Before any simulation, refuse an mp4 if ffmpeg is missing."""
    if path.suffix.lower() == ".mp4":
        _find_ffmpeg()


def _write_gif(scene: FlatScene, path: Path) -> None:
    """Write a gif with as many frames as `MAX_GIF_SIZE` allows."""
    stride = max(1, round(SECONDS_PER_FRAME / scene.step))
    while len(content := _encode_gif(scene, stride)) > MAX_GIF_SIZE and stride < scene.sample_count:
        stride *= 2
    path.write_bytes(content)


def _encode_gif(scene: FlatScene, stride: int) -> bytes:
    from PIL.Image import Dither

    frames = list(draw_frames(scene, stride))
    palette = frames[len(frames) * 2 // 3].quantize(PALETTE_SIZE)
    frames = [frame.quantize(palette=palette, dither=Dither.NONE) for frame in frames]
    pause, buffer = round(stride * scene.step * 1000), BytesIO()
    frames[0].save(buffer, "GIF", save_all=True, append_images=frames[1:], loop=0, optimize=False,
                   duration=[pause] * (len(frames) - 1) + [round(LAST_FRAME_DURATION * 1000)])
    return buffer.getvalue()


def _write_mp4(scene: FlatScene, path: Path) -> None:
    frames = list(draw_frames(scene, stride=1))
    frames += frames[-1:] * round(LAST_FRAME_DURATION / scene.step)
    width, height = frames[0].size
    command = [_find_ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
               "-r", f"{1 / scene.step:.6g}", "-i", "-", "-threads", "1", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "26",
               "-movflags", "+faststart", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1", str(path)]
    process = subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), capture_output=True, check=False)
    if process.returncode != 0:
        last_line = (process.stderr.decode(errors="replace").strip() or "no message").splitlines()[-1]
        raise SafevarError(f"{path}: ffmpeg failed: {last_line}")


def _find_ffmpeg() -> str:
    """The path of ffmpeg: on the PATH, or else in the package imageio-ffmpeg."""
    program = shutil.which("ffmpeg")
    if program is not None:
        return program
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise InputError("animate", "an mp4 needs ffmpeg, which is not installed",
                         "ffmpeg on the PATH, or in the checkout: pip install '.[film]'; a .gif or .html needs neither") from None


def _write_page(scene: FlatScene, path: Path) -> None:
    from safevar_sumo.replay.page import animation_page

    path.write_text(animation_page(scene), encoding="utf-8", newline="\n")


ANIMATION_WRITERS: Mapping[str, Callable[[FlatScene, Path], None]] = {".gif": _write_gif, ".mp4": _write_mp4, ".html": _write_page}
"""Functions that write an animation, by the file's ending."""
