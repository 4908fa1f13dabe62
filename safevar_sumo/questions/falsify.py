"""The falsification of the claim that all settings of a box are safe in some models: a search for
settings that are unsafe in any of them.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.records import FloatArray, IntArray

GENERATION, PARENTS = 512, 32
"""Settings of a generation; the worst ones so far, which are its parents."""
STEP, PULL = 0.1, 0.5
"""Step of a mutation, as a share of the way to a random value; share of the way to a worse parent.
"""
DIFFERENCE = 0.7
"""Factor on the difference of two parents (F of differential evolution; Storn and Price 1997)."""
MORE_GENERATIONS = 2
"""Generations after the first with an unsafe setting: several failures at once spare searches of
boxes beside them.
"""
Judge = Callable[[FloatArray], FloatArray]
"""What each of M settings leaves to the limit in a model, shape (M,): below 0 it is unsafe;
infinite where it does not count.
"""


class Falsification(NamedTuple):
    """The worst settings that a falsification met, worst first; all unsafe ones are among them.

    Attributes
    ----------
    settings, judges, robustness
        Settings, shape (K, n), the numbers of the judges that they met, and their robustness, shape
        (K,): below 0 where they are unsafe.
    simulated
        Number of settings that were simulated, each in one encounter and one model.
    """

    settings: FloatArray
    judges: IntArray
    robustness: FloatArray
    simulated: int

    @property
    def failures(self) -> dict[int, FloatArray]:
        """The unsafe settings, shape (K, n), by the number of the judge; none if the claim held."""
        is_unsafe = self.robustness < 0
        return {
            judge: self.settings[is_unsafe & (self.judges == judge)]
            for judge in np.unique(self.judges[is_unsafe]).tolist()
        }


def falsify_all(
    boxes: Sequence[Box],
    judges: Sequence[Judge],
    known: Sequence[Sequence[FloatArray]],
    budget: int,
    rngs: Sequence[np.random.Generator],
    generation: int = GENERATION,
    begun: Sequence[Falsification] = (),
) -> list[Falsification]:
    """Falsify the claim about several boxes side by side, each with `budget` simulations,
    `generation` of them at once: a judge meets a generation of all boxes together, as few large
    batches cost less than many small ones. What was `begun` goes on with its children. A search
    ends `MORE_GENERATIONS` after a setting is unsafe.
    """
    found = dict[int, Falsification]()
    before: Sequence[Falsification | None] = begun or [None] * len(boxes)
    steps = [
        _steps(box, len(judges), of_box, budget, generation, rng, of_before)
        for box, of_box, rng, of_before in zip(boxes, known, rngs, before, strict=True)
    ]
    waiting = dict[int, _Generation]()

    def go_on(number: int, robustness: FloatArray | None) -> None:
        step = steps[number]
        try:
            waiting[number] = (
                next(step) if robustness is None else step.send(robustness)
            )
        except StopIteration as end:
            found[number] = end.value

    for number in range(len(boxes)):
        go_on(number, None)
    while waiting:
        # All boxes' generations meet each judge in one batch.
        numbers = [*waiting]
        generations = [*waiting.values()]
        waiting.clear()
        settings = np.concatenate([each.settings for each in generations])
        met = np.concatenate([each.judges for each in generations])
        robustness = np.full(len(settings), np.inf)
        for judge in np.unique(met):
            robustness[met == judge] = judges[judge](settings[met == judge])
        ends = np.cumsum([len(each.settings) for each in generations])[:-1]
        for number, of_box in zip(numbers, np.split(robustness, ends), strict=True):
            go_on(number, of_box)
    return [found[number] for number in range(len(boxes))]


class _Generation(NamedTuple):
    """Settings, shape (M, n), and the numbers of the judges that they are to meet."""

    settings: FloatArray
    judges: IntArray


def _steps(
    box: Box,
    n_judges: int,
    known: Sequence[FloatArray],
    budget: int,
    size: int,
    rng: np.random.Generator,
    found: Falsification | None,
) -> Generator[_Generation, FloatArray, Falsification]:
    """The generations of a falsification, which takes what each leaves."""
    empty = np.zeros((0, len(box.lower)))
    found = found or Falsification(empty, np.zeros(0, dtype=np.intp), np.zeros(0), 0)
    seen = set[tuple[int, bytes]]()
    generations_left = 1 + MORE_GENERATIONS
    settings = np.concatenate([empty, *known])
    numbers = np.repeat(np.arange(len(known)), [len(rows) for rows in known]).astype(
        np.intp
    )
    least = np.full(n_judges, np.inf)
    generation = 0
    if len(found.settings):
        np.minimum.at(least, found.judges, found.robustness)
        generation = 1
        settings = _children(box, found, max(size, GENERATION), rng)
        numbers = _pair(least, generation)[np.arange(len(settings)) // 2 % 2]
    while found.simulated < budget:
        # The first generation holds all known settings, and random ones; more known settings than
        # a generation get as many random ones beside them.
        is_large = generation == 0 and len(settings) > size
        number = min(
            len(settings) + size if is_large else size, budget - found.simulated
        )
        choice = np.arange(n_judges) if generation == 0 else _pair(least, generation)
        settings, numbers = _new_ones(box, settings, numbers, choice, number, seen, rng)
        if not len(settings):
            break
        robustness = yield _Generation(settings, numbers)
        np.minimum.at(least, numbers, robustness)
        found = _worst(found, settings, numbers, robustness)
        generations_left -= int((found.robustness < 0).any())
        if not generations_left:
            break
        settings = _children(box, found, max(size, GENERATION), rng)
        generation += 1
        # Of two neighbours one is mutated and one moved: each judge gets both.
        numbers = _pair(least, generation)[np.arange(len(settings)) // 2 % 2]
    return found


def _pair(least: FloatArray, generation: int) -> IntArray:
    """The judges of a generation: that with the least left, and another one in turn."""
    first, *others = np.argsort(least, kind="stable").tolist()
    second = others[(generation - 1) % len(others)] if others else first
    return np.array([first, second])


def _new_ones(
    box: Box,
    settings: FloatArray,
    numbers: IntArray,
    choice: IntArray,
    size: int,
    seen: set[tuple[int, bytes]],
    rng: np.random.Generator,
) -> tuple[FloatArray, IntArray]:
    """Up to `size` settings of the box that their judges have not met; random ones where there are
    too few.
    """
    is_held = box.holds(settings)
    random = box.draw(size, rng)
    settings = np.concatenate([settings[is_held], random])
    numbers = np.concatenate(
        [numbers[is_held], choice[rng.integers(len(choice), size=len(random))]]
    )
    rows = list[int]()
    for row, key in enumerate(
        zip(numbers.tolist(), map(np.ndarray.tobytes, settings), strict=True)
    ):
        if key not in seen and len(rows) < size:
            seen.add(key)
            rows.append(row)
    return settings[rows], numbers[rows]


def _worst(
    found: Falsification,
    settings: FloatArray,
    numbers: IntArray,
    robustness: FloatArray,
) -> Falsification:
    """The falsification after a generation, with the worst settings that count, and all unsafe
    ones.
    """
    is_counted = np.isfinite(robustness)
    all_robustness = np.concatenate([found.robustness, robustness[is_counted]])
    worst = np.argsort(all_robustness, kind="stable")[
        : max(PARENTS, np.count_nonzero(all_robustness < 0))
    ]
    return Falsification(
        np.concatenate([found.settings, settings[is_counted]])[worst],
        np.concatenate([found.judges, numbers[is_counted]])[worst],
        all_robustness[worst],
        found.simulated + len(robustness),
    )


def _children(
    box: Box, found: Falsification, number: int, rng: np.random.Generator
) -> FloatArray:
    """A number of children; none before a setting counts."""
    parents = found.settings[:PARENTS]
    if not len(parents):
        return parents
    shape = (number, len(box.lower))
    first, second, third, fourth = rng.integers(len(parents), size=(4, number))
    mixed = np.where(rng.random(shape) < 0.5, parents[first], parents[second])
    random = box.at(rng.random(shape))
    ends = np.where(rng.random(shape) < 0.5, box.lower, box.upper)
    # Of a child's values, 0.4 on average are drawn anew, 0.4 make a step, and 0.4 go to an end.
    draw = rng.random(shape) * max(int(np.count_nonzero(box.lower < box.upper)), 1)
    mutated = np.select(
        [draw < 0.4, draw < 0.8, draw < 1.2],
        [random, mixed + STEP * (random - mixed), ends],
        mixed,
    )
    worse = parents[np.minimum(first, second)]  # the worst parents come first
    moved = (
        parents[first]
        + PULL * (worse - parents[first])
        + DIFFERENCE * (parents[third] - parents[fourth])
    )
    is_moved = (np.arange(number) % 2 == 1)[:, np.newaxis]
    return np.asarray(np.clip(np.where(is_moved, moved, mutated), box.lower, box.upper))
