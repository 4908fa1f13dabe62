"""A comparison that moves: as a gif, a film, or a page that plays in a browser."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.replay.comparison import Comparison
from safevar_sumo.replay.raster import pictures
from safevar_sumo.replay.scene import Scene, scene_of

SECONDS_PER_PICTURE = 0.1
"""Of a gif; it knows hundredths of a second only."""
LAST_PICTURE = 2.0
"""How long a gif rests on its last picture [s]."""
COLOURS = 64
LARGEST_GIF = 1_000_000
"""A longer one gets fewer pictures [bytes]."""


def animate(comparison: Comparison, path: Path) -> None:
    """Write a comparison as an animation, of the kind that the file's ending says; the same one gives the same bytes.

    Raises
    ------
    InputError
        If the ending is unknown, the file cannot be written, or a film is asked for and there is no ffmpeg.
    """
    ending = path.suffix.lower()
    if ending not in ANIMATIONS:
        raise InputError("animate", str(path), f"a file that ends in {', '.join(ANIMATIONS)}")
    try:
        ANIMATIONS[ending](scene_of(comparison), path)
    except OSError as error:
        raise InputError("animate", f"cannot write {path}: {error.strerror or error}", "a file in a directory that exists") from None


def check_animation(path: Path) -> None:
    """Refuse what `animate` would, before anything is simulated."""
    if path.suffix.lower() == ".mp4":
        _ffmpeg()


def _gif(scene: Scene, path: Path) -> None:
    """As many pictures as fit into the largest size."""
    stride = max(1, round(SECONDS_PER_PICTURE / scene.step))
    while len(written := _gif_of(scene, stride)) > LARGEST_GIF and stride < scene.length:
        stride *= 2
    path.write_bytes(written)


def _gif_of(scene: Scene, stride: int) -> bytes:
    from PIL.Image import Dither

    frames = list(pictures(scene, stride))
    palette = frames[len(frames) * 2 // 3].quantize(COLOURS)
    frames = [frame.quantize(palette=palette, dither=Dither.NONE) for frame in frames]
    pause, buffer = round(stride * scene.step * 1000), BytesIO()
    frames[0].save(buffer, "GIF", save_all=True, append_images=frames[1:], loop=0, optimize=False,
                   duration=[pause] * (len(frames) - 1) + [round(LAST_PICTURE * 1000)])
    return buffer.getvalue()


def _film(scene: Scene, path: Path) -> None:
    frames = list(pictures(scene, 1))
    frames += frames[-1:] * round(LAST_PICTURE / scene.step)
    width, height = frames[0].size
    command = [_ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
               "-r", f"{1 / scene.step:.6g}", "-i", "-", "-threads", "1", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "26",
               "-movflags", "+faststart", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1", str(path)]
    done = subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), capture_output=True, check=False)
    if done.returncode != 0:
        raise SafevarError(f"{path}: ffmpeg failed: {(done.stderr.decode(errors='replace').strip() or 'no message').splitlines()[-1]}")


def _ffmpeg() -> str:
    """The program that encodes films: on the path, or the one that the package imageio-ffmpeg brings."""
    found = shutil.which("ffmpeg")
    if found is not None:
        return found
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise InputError("animate", "there is no ffmpeg to encode an mp4 with",
                         "ffmpeg on the PATH, or pip install 'safevar_sumo[film]'; a .gif or .html needs neither") from None


def _page(scene: Scene, path: Path) -> None:
    from safevar_sumo.replay.page import animation_page

    path.write_text(animation_page(scene), encoding="utf-8", newline="\n")


ANIMATIONS: Mapping[str, Callable[[Scene, Path], None]] = {".gif": _gif, ".mp4": _film, ".html": _page}
"""How an animation is written, by its file's ending."""
