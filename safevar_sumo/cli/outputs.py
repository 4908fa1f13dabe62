"""Files that a command is to write, refused before the work whose result they are to take."""

from __future__ import annotations

from pathlib import Path

from safevar_sumo.errors import InputError
from safevar_sumo.study import check_writable

PICTURES = (".png", ".pdf", ".svg")


def check_output(path: Path, flag: str, endings: tuple[str, ...]) -> None:
    """Refuse a file of an unknown kind or one that cannot be written.

    Raises
    ------
    InputError
        Naming the flag and what is legal.
    """
    if path.suffix.lower() not in endings:
        raise InputError(flag, str(path), f"a file that ends in {', '.join(endings)}")
    check_writable(path, flag)


def refuse_inputs(path: Path, flag: str, *inputs: str | Path) -> None:
    """Refuse to write over what a command reads: a file, or a file of a results directory.

    Raises
    ------
    InputError
        Naming the flag and the file.
    """
    if not path.exists():
        return
    for one in map(Path, inputs):
        read = [one, *one.glob("*.*"), *one.glob("runs/*")] if one.is_dir() else [one]
        if any(place.exists() and path.samefile(place) for place in read if place.suffix not in PICTURES):
            raise InputError(flag, f"{path} is what the command reads", "another file")
