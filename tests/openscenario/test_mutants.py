"""Files with one thing wrong at random: refused by name, or played with finite numbers."""

from __future__ import annotations

import random
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario import Played, play

FILES = Path(__file__).parent / "files"
NASTY = (
    *("", "x", "nan", "inf", "-1", "0", "1e300", "1e9", "-1e-300", "1" * 4400, "${", "$nobody"),
    *("${1/0}", "true", "-7", "3.5", "Ego", "none", "linear", "lessThan", "\u0663", " 5 "),
)
"""Values that an attribute should mostly not have."""


def mutate(root: ElementTree.Element, rng: random.Random) -> None:
    """Change one attribute, or remove, repeat, rename, move or swap one element."""
    parents = [(parent, child) for parent in root.iter() for child in parent]
    parent, child = rng.choice(parents)
    place = list(parent).index(child)
    match rng.choice(("value", "value", "attribute", "remove", "repeat", "rename", "move", "swap")):
        case "value":
            named = [one for one in root.iter() if one.attrib]
            one = rng.choice(named)
            one.set(rng.choice(sorted(one.attrib)), rng.choice(NASTY))
        case "attribute":
            one = rng.choice([one for one in root.iter() if one.attrib])
            del one.attrib[rng.choice(sorted(one.attrib))]
        case "remove":
            parent.remove(child)
        case "repeat":
            parent.insert(place, child)
        case "rename":
            child.tag = rng.choice([one.tag for _, one in parents])
        case "move":
            other = rng.choice(parents)[1]
            if child not in other.iter() and other not in child.iter():
                parent.remove(child)
                other.append(child)
        case "swap":
            parent[place] = rng.choice(parents)[1]
            if any(one is parent for one in parent[place].iter()):
                parent[place] = child


def tried(folder: Path, files: Sequence[Path], seed: int) -> Played | InputError:
    """What becomes of a mutant of one of some files, or of its road."""
    rng = random.Random(seed)
    file = folder / rng.choice(files).name
    target = rng.choice((file, file, file, folder / "roads" / "three_lanes.xodr"))
    original = target.read_bytes()
    tree = ElementTree.ElementTree(ElementTree.fromstring(original))
    mutate(tree.getroot(), rng)
    tree.write(target)
    try:
        return play(str(file), {})
    except InputError as error:
        return error
    finally:
        target.write_bytes(original)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_mutants_are_refused_or_played(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    shutil.copytree(FILES, folder)
    files = sorted(FILES.glob("*.xosc"))
    refused = 0
    for seed in range(300):
        found = tried(folder, files, seed)
        if isinstance(found, InputError):
            refused += 1
            assert found.legal, (seed, found.problem)
            assert "cannot be played" not in found.problem, (seed, found.problem)
            continue
        assert 0 <= found.depends_until <= found.duration <= 604
        assert all(np.isfinite([*one.place, *one.speed]).all() for one in found.others), seed
    assert 100 < refused < 290
