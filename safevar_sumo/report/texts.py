"""Questions of pages and packs: this module reads them from texts, completes them with options of
the page, and answers them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import split
from typing import Any

from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, check_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.ask import QUICK, SIMULATIONS, Question, find_question
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.options import CRITERION
from safevar_sumo.records import JsonObject
from safevar_sumo.terminal import Progress


def parse_question(text: str) -> tuple[Question, JsonObject]:
    """Read a question and the values of its options from a text, a command without a study or
    results: `risk --samples 4000`.

    Raises
    ------
    InputError
        If there is no such question or option, or a value is not allowed.
    """
    try:
        name, *words = split(text)
    except ValueError:
        # The text is empty, or lacks the second of two quotation marks.
        raise InputError(
            "ask",
            repr(text),
            'a question with its options, such as "risk --samples 4000"',
        ) from None
    question = find_question(name)

    values = JsonObject()
    waiting = iter(words)
    known = (*question.options.values(), SIMULATIONS)
    options = {option.flag: option for option in known}
    for flag in waiting:
        check_name("ask", f"{name} has no option {flag!r}", flag, options)
        option = options[flag]
        if option.name in values and not option.is_repeated:
            raise InputError(f"ask: {name} {flag}", "is given twice", "it once")
        value: Any = True
        if option.kind is not bool:
            word = next(waiting, None)
            if word is None:
                raise InputError(
                    f"ask: {name} {flag}", "no value", f"a value after {flag}"
                )
            try:
                value = option.kind(word)
            except ValueError:
                raise InputError(
                    f"ask: {name} {flag}", repr(word), option.kind.__name__
                ) from None
        if option.is_repeated:
            value = *values.get(option.name, ()), value
        values[option.name] = option.check(value)
    return question, values


def completed(
    question: Question,
    values: JsonObject,
    unsafe: Unsafe | None,
    part: int | None,
    *,
    quick: bool,
) -> JsonObject:
    """The values of a question's options, with values of the page for options that the question
    does not state: the criterion, `part` of the simulations, and whether the answer is rough.
    """
    usual: JsonObject = {SIMULATIONS.name: part}
    if unsafe is not None and any(
        option.metavar == CRITERION for option in question.options.values()
    ):
        usual["unsafe"] = unsafe
    if quick and question.has_rough_answer:
        usual[QUICK] = True
    return usual | values


def answer_about(  # noqa: PLR0913 - options of the command `report`
    question: Question,
    values: JsonObject,
    cases: Sequence[Results],
    directories: Sequence[Path],
    point: str | None,
    jobs: int | None,
    progress: Progress,
    *,
    is_asked: bool,
    as_it_is_now: bool = False,
    pool: Pool | None = None,
    questions: int = 1,
) -> Answer:
    """The answer to a question about results. If the question has no answer, and the user has not
    asked it (`is_asked` is false), the answer is the reason.

    Raises
    ------
    InputError
        If the user has asked the question, and it has no answer, or is about another number of
        results.
    """
    options = {**values}
    simulations = options.pop(SIMULATIONS.name, None)
    try:
        if len(question.others) + 1 != len(cases):
            raise InputError(
                "ask",
                f"{question.name} cannot be asked about {len(cases)}",
                f"{len(question.others) + 1} results directories",
            )
        command = question.command_line(
            [str(directory) for directory in directories], {"point": point}, options
        )
        answer = question.answer(
            cases,
            options,
            pool=pool,
            jobs=jobs,
            simulations=simulations,
            progress=progress,
            as_it_is_now=as_it_is_now,
            questions=questions,
        )
    except InputError as error:
        if is_asked:
            raise
        return Answer(
            question=question.name,
            study=cases[0].study,
            verdict=f"No answer: {error.problem} (expected: {error.legal}).",
            numbers={},
            tables={},
        )
    return replace(answer, command=command + answer.command)
