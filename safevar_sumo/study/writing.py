"""Study files written."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import tomli_w

from safevar_sumo.errors import InputError
from safevar_sumo.study.files import refuse_other_than_file
from safevar_sumo.study.reading import without_nothing
from safevar_sumo.study.schema import NAME, Study, tables_of


def write_study(path: Path, study: Study, comment: str) -> None:
    """Write a complete study file that begins with a comment; the study is called as the file, as far as that is a name.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    if re.fullmatch(NAME, path.stem):
        study = msgspec.structs.replace(study, name=path.stem)
    tables = {name: value for name, value in without_nothing(tables_of(study)).items() if value != {}}
    printable = ("".join(character if character.isprintable() else "?" for character in line) for line in comment.splitlines())
    text = "".join(f"# {line}".rstrip() + "\n" for line in printable) + "\n" + tomli_w.dumps(tables)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError("out", f"cannot write {path}: {error.strerror}", "a file in a directory that exists") from None


def check_writable(path: Path, source: str = "out") -> None:
    """Refuse a file that cannot be written before the work whose result it is to take.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        refuse_other_than_file(path, source, streams=True)
        is_new = not path.exists()
        with path.open("a"):
            pass
        if is_new:
            path.unlink()
    except OSError as error:
        raise InputError(source, f"cannot write {path}: {error.strerror}", "a file in a directory that exists") from None
