"""A question is a function `(subject, evaluator, *, options) -> Answer`. The class `Question` makes
a function of the library of it, which loads the subjects and opens the evaluator.

The command line (`cli/command.py`) makes a command of the same signature and docstring, as it does
for every other public function.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, update_wrapper
from importlib import import_module, invalidate_caches
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console

from safevar_sumo.errors import InputError, NobodyMoved, unknown_name, warn
from safevar_sumo.metrics import Unsafe
from safevar_sumo.plugins import add_import_folders
from safevar_sumo.plugins.contract import user_errors
from safevar_sumo.questions.arguments import (
    POOL,
    PROGRESS,
    check_kind,
    unknown_argument,
)
from safevar_sumo.questions.options import (
    CARS_FILE,
    CRITERION,
    UP_TO,
    Cluster,
    Jobs,
    Option,
    PointName,
    Simulations,
    UpTo,
    flag_of,
    options_of,
)
from safevar_sumo.questions.sentence import Sentence, Verdict, answer, note
from safevar_sumo.questions.subject import (
    part_of,
    study_in,
    study_or_case,
    with_own_set,
)
from safevar_sumo.records import JsonObject
from safevar_sumo.shipped import PACKAGE, PROGRAM_COMMAND
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.terminal import Parts, Progress, open_progress, print_text

if TYPE_CHECKING:
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.questions.answer import Answer
    from safevar_sumo.questions.case import Results, Subject
    from safevar_sumo.questions.evaluator import Evaluator

QUESTIONS = {
    "compare": "safevar_sumo.questions.compare",
    "explain": "safevar_sumo.questions.explain",
    "permit": "safevar_sumo.questions.permit",
    "repair": "safevar_sumo.questions.repair",
    "risk": "safevar_sumo.questions.risk",
    "rules": "safevar_sumo.questions.rules",
    "tolerance": "safevar_sumo.questions.tolerance",
    "validate": "safevar_sumo.reference.agreement",
}
"""The module of each question, whose function has the question's name."""


Criterion = Annotated[Unsafe | None, CRITERION]
"""What is unsafe: a collision, a clearance below X between bumpers [m], or a metric of the study
with <, <=, > or >= and a number; by default a collision if any evaluated setting collides, else a
safety degree below half of the original's.
"""
SUBJECTS = "a study, or the directory of results"
"""What a question may be about, for errors."""
QUICK = "quick"
"""The option that asks for a rough answer. Only some questions have it."""
ROUGH = answer(
    "Rough answer (--quick): at most an eighth of the search was simulated, with one parameter set,"
    " and proves nothing."
)
ROUGH_WITHOUT_SETS = answer(
    "Rough answer (--quick): at most an eighth of the search was simulated, and proves nothing."
)
ROUGH_OF_FEW = answer(
    "Rough answer (--simulations {most}): fewer simulations than usual were allowed."
)
"""The first sentence of a rough answer: with `--quick`, of a study with and without further
parameter sets of its vehicle model, and with `--simulations`.
"""
CRITERION_OF_STUDY = note("Criterion: {criterion} ({source}).")
STANDING = note(
    "Remark: {count} never moved, although the original vehicle moves in the same encounter. The"
    " answer counts such a vehicle neither as safe nor as unsafe."
)
NOBODY_MOVED = answer(
    "No verdict is possible, because no changed vehicle moved. {count} never moved, although the"
    " original vehicle moves in the same encounter. Find out why such a vehicle stands: {command}"
)
"""Sentences on vehicles that never moved; the second one if there are no others."""
NOT_SIMULATED = note("Not simulated: {parts}.")
"""Notes on the criterion that a study states: its source, and the parts that are not simulated."""


def _type_name(parameter: inspect.Parameter) -> str:
    """The name of a parameter's type without its module. The annotation is a text in a module with
    postponed annotations, and otherwise the type.
    """
    annotation = parameter.annotation
    return str(getattr(annotation, "__name__", annotation)).rpartition(".")[2]


class Question:
    """A question as a function of the library: `risk("rain", samples=1000)`."""

    def __init__(self, compute: Callable[..., Answer]) -> None:
        update_wrapper(self, compute)
        is_own = compute.__module__.partition(".")[0] == PACKAGE.name
        self.compute = compute
        self.name = f"{'' if is_own else f'{compute.__module__}:'}{compute.__name__}"

        # The first two parameters must be positional. Kinds of parameters are ordered: all
        # positional kinds are at most POSITIONAL_OR_KEYWORD.
        signature = inspect.signature(compute)
        parameters = list(signature.parameters.values())
        last_kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        if len(parameters) < 2 or parameters[1].kind > last_kind:
            raise InputError(
                f"question {self.name!r}",
                f"takes {signature}",
                "(subject, evaluator), then other subjects, * and options",
            )
        self.takes_results_only = _type_name(parameters[0]) == "Results"
        self.others = {
            parameter.name: _type_name(parameter) == "Path"
            for parameter in parameters[2:]
            if parameter.kind is not parameter.KEYWORD_ONLY
        }
        """Whether each further positional parameter is a file instead of a subject, by name."""
        common_parameters = inspect.signature(Question.__call__).parameters
        # A user passes no evaluator: the signature for users lacks it.
        parameters.pop(1)
        texts = [inspect.cleandoc(compute.__doc__ or "")]
        for name, option in COMMON_OPTIONS.items():
            if name not in signature.parameters:
                parameters.append(common_parameters[name])
                texts.append(f"{name}\n    {option.meaning}")
        self.__signature__ = inspect.Signature(parameters, return_annotation="Answer")
        self.__doc__ = "\n".join(texts)

    @cached_property
    def options(self) -> dict[str, Option]:
        """The question's own options by name. The options that all questions have are left out."""
        return options_of(self.compute)

    @property
    def has_rough_answer(self) -> bool:
        """Whether `--quick` asks for a rough answer."""
        return QUICK in self.options

    def __call__(
        self,
        source: StudyLike | Results | None = None,
        *further_sources: StudyLike | Results,
        point: PointName = None,
        ranges: bool = False,
        up_to: UpTo = None,
        jobs: Jobs = None,
        cluster: Cluster = None,
        simulations: Simulations = None,
        pool: Any = None,
        progress: Any = False,
        as_it_is_now: bool = False,
        fresh: bool = False,
        **values: Any,
    ) -> Answer:
        """The answer about a study, or results, and other subjects.

        Parameters
        ----------
        point
            Use only this test or test case of the study, such as CPNA. Default: all tests.
        ranges
            Use every encounter within the ranges that the study states. Default: only the listed
            test cases.
        up_to
            Use only encounters in which this value is not exceeded, such as speed=40. The unit is
            that of the study.
        jobs
            Number of worker processes. Default: one for each processor core.
        cluster
            Simulate on the workers of this Dask scheduler, such as tcp://host:8786. Default: on
            this machine.
        simulations
            Largest number of simulations. Default: no limit, or in a slow simulator as many as take
            15 minutes.
        pool
            Pool that simulates; by default new worker processes.
        progress
            True for a bar on the terminal, or a function of a phase, the number of simulations
            done, and their total.
        as_it_is_now
            Use the present files and versions, although the results were computed with other files
            or versions. Default: an error.
        fresh
            Simulate everything again. Default: use simulations of earlier commands again.
        """
        # A question with an option `up_to` of its own leaves out encounters itself: its subjects
        # keep all encounters.
        cut = up_to
        if UP_TO in self.options:
            cut = None
            values[UP_TO] = up_to
        self._check_names(further_sources, values)
        if source is None:
            raise InputError(f"{self.name}()", "source = None", SUBJECTS)
        how: JsonObject = {
            "jobs": jobs,
            "cluster": cluster,
            "simulations": simulations,
            "as_it_is_now": as_it_is_now,
        }
        where = {"point": point, "ranges": ranges, "up_to": up_to}
        common = {**where, **how, "fresh": fresh}
        for name, value in common.items():
            COMMON_OPTIONS[name].check(value)
        check_kind("pool", pool, POOL)
        check_kind("progress", progress, PROGRESS)
        how["pool"] = pool
        values = {
            name: self.options[name].check(value) for name, value in values.items()
        }

        def subject_of(source: StudyLike | Results) -> Subject:
            """Load the subject of the question, and cut it to the part that is asked about."""
            subject = study_or_case(
                source, as_it_is_now=as_it_is_now, results_only=self.takes_results_only
            )
            if not isinstance(subject, Study) and subject.shortfall:
                warn(subject.shortfall)
            return part_of(subject, ranges, point, cut)

        from safevar_sumo.campaign.cache import keep_simulations

        names = [_name(source), *map(_name, further_sources)]
        cuts = {"ranges": ranges, "point": point, "up_to": cut}
        command = self.command_line(names, cuts, values)
        subjects: list[Any] = [subject_of(source)]
        for further, is_file in zip(further_sources, self.others.values(), strict=True):
            subjects.append(Path(str(further)) if is_file else subject_of(further))
        with keep_simulations(command, fresh=fresh):
            # On a terminal, a rough answer is computed and shown first, because it comes much
            # earlier than the answer.
            is_long = self.has_rough_answer and simulations is None
            is_short = values.get(QUICK) or values.get("out")
            is_shown = progress is True and sys.stderr.isatty()
            if is_long and not is_short and is_shown:
                with open_progress(True) as show:
                    part = Parts(show).begin("rough answer")
                    rough = self.answer(
                        subjects, {**values, QUICK: True}, **how, progress=part
                    )
                print_text(Console(stderr=True), f"{rough.verdict}\n")
            answer = self.answer(
                subjects, values, **how, progress=progress, called=_name(source)
            )
        return replace(answer, command=command + answer.command)

    def _check_names(
        self, further_sources: Sequence[object], values: JsonObject
    ) -> None:
        """Refuse options that the question does not have, and another number of subjects."""
        for name in values:
            if name not in self.options:
                known = {"source": None, **self.options, **COMMON_OPTIONS}
                raise unknown_argument(self.name, name, known)
        if len(further_sources) != len(self.others):
            names = ["source", *self.others]
            raise InputError(f"{self.name}()", f"takes exactly {' and '.join(names)}")

    def answer(
        self,
        subjects: Sequence[Any],
        values: JsonObject,
        *,
        pool: Pool | None = None,
        jobs: int | None = None,
        cluster: str | None = None,
        simulations: int | None = None,
        progress: bool | Progress = False,
        called: str = "",
        as_it_is_now: bool = False,
        questions: int = 1,
    ) -> Answer:
        """The answer about subjects that have been loaded.

        The answer's `command` is only the end of a command line: the option for the largest number
        of simulations, if there is such a number.

        Parameters
        ----------
        subjects
            Studies, results, or paths of files.
        values
            Values of options, by name.
        called
            The name of the first subject in the command that the answer recommends next; "" for no
            command.
        questions
            Number of questions that share the time, such as all questions of a page.
        """
        from safevar_sumo.questions.by_criterion import subject_by
        from safevar_sumo.questions.case import Results

        # The evaluator loads SUMO, which takes long: import it only when a question is asked.
        from safevar_sumo.questions.evaluator import open_evaluator

        is_quick = bool(values.get(QUICK))
        has_sets = any(study_in(subject).spread for subject in subjects)
        if is_quick:
            subjects = list(map(with_own_set, subjects))
        study = study_in(subjects[0])
        with (
            open_progress(progress) as show,
            open_evaluator(study, pool, jobs, show, cluster) as opened,
        ):
            opened.allow(simulations, questions, quick=is_quick)
            budget = opened.budget
            tally = opened.tally
            for subject in subjects:
                if isinstance(subject, Results) and not as_it_is_now:
                    opened.for_study(subject.study).refuse_other_original(subject)
            unsafe, values, cites = self._criterion(values, study)
            evaluator = opened
            if unsafe is not None:
                subjects = [subject_by(subject, unsafe, opened) for subject in subjects]
                study = study_in(subjects[0])
                evaluator = opened.for_study(study)
                evaluator.use(unsafe)

            result = self._computed(subjects, evaluator, values)

            # If the driving system fails by itself, the answer begins with a sentence that says so.
            if result.study is not study:
                reason = evaluator.for_study(result.study).no_verdict
            else:
                reason = evaluator.no_verdict
            evaluator.end()
        numbers = {"driven": not reason, **result.numbers}
        rough: list[Sentence] = []
        if is_quick:
            rough = [ROUGH if has_sets else ROUGH_WITHOUT_SETS]
        if budget.limit is not None:
            numbers |= {"rough": True, "simulations": budget.spent}
            rough = [ROUGH_OF_FEW(most=budget.limit)]
        if self.has_rough_answer:
            numbers["rough"] = bool(rough or numbers.get("rough"))
        sentences = [
            answer(reason),
            *rough,
            *Verdict.of(result.verdict).sentences,
            *cites,
            note(tally.undefined_in_words),
            note(tally.collided_in_words),
        ]
        numbers["never_moved"] = len(tally.standing)
        if tally.standing and numbers["driven"]:
            sentences.append(STANDING(count=tally.standing_in_words))
        limit = budget.stated if budget.limit is None else budget.limit
        return replace(
            result,
            verdict=Verdict(sentences),
            numbers=numbers,
            next=result.next or self._next(subjects[0], evaluator, called, values),
            command="" if limit is None else f" --simulations {limit}",
        )

    def _computed(
        self, subjects: Sequence[Any], evaluator: Evaluator, values: JsonObject
    ) -> Answer:
        """What the question's function returns, or an answer without a verdict if no changed
        vehicle moved.
        """
        from safevar_sumo.questions.answer import Answer

        subject, *others = subjects
        try:
            with user_errors(self.name):
                result = self.compute(subject, evaluator, *others, **values)
        except NobodyMoved:
            return self._no_verdict(evaluator)
        if not isinstance(result, Answer):
            problem = f"returns {type(result).__name__}"
            raise InputError(
                self.name, problem, "an Answer (safevar_sumo.questions.answer)"
            )
        return result

    def _no_verdict(self, evaluator: Evaluator) -> Answer:
        """The answer if no changed vehicle moved."""
        from safevar_sumo.questions.answer import Answer

        study = evaluator.study
        reason = NOBODY_MOVED(
            count=evaluator.tally.standing_in_words,
            command=f"{PROGRAM_COMMAND} check {study.words}",
        )
        return Answer(
            question=self.name,
            study=study,
            verdict=Verdict([reason]),
            numbers={"driven": False},
            tables={},
            failures=(reason.text,),
        )

    def _criterion(
        self, values: JsonObject, study: Study
    ) -> tuple[Unsafe | None, JsonObject, Sequence[Sentence]]:
        """The criterion of an unsafe vehicle, the values of options with it, and notes on its
        source. If a user states neither a criterion nor a margin, the criterion of the study
        counts. The criterion is None if nobody states one, or if the question uses none.
        """
        names = [
            name for name, option in self.options.items() if option.metavar == CRITERION
        ]
        if not names:
            return None, values, ()
        (name,) = names
        # A user who states a distance to keep (margin) means collisions, even if the study states
        # another criterion.
        if values.get(name) is not None or values.get("margin") is not None:
            return values.get(name), values, ()
        stated = study.unsafe
        cites = []
        if stated.source:
            cites.append(
                CRITERION_OF_STUDY(criterion=stated.criterion, source=stated.source)
            )
        if stated.not_simulated:
            cites.append(NOT_SIMULATED(parts=stated.not_simulated))
        criterion = None
        if stated.criterion:
            criterion = Unsafe.parse(stated.criterion)
        return criterion, {**values, name: criterion}, cites

    def _next(
        self, subject: Subject, evaluator: Evaluator, called: str, values: JsonObject
    ) -> str:
        """The command that a user should call next; "" if it could give no answer. After results
        the next command needs only their directory. A study must be searched (`study`) before a
        page can report on it. If nobody else is on the road, a criterion must say what is unsafe.
        """
        from safevar_sumo.questions.answer import contents_of

        declared = contents_of(self.compute)
        if not (declared and declared.next and called) or (
            evaluator.system.meets_nobody and not evaluator.study.unsafe.criterion
        ):
            return ""
        if not isinstance(subject, Study):
            return f"{PROGRAM_COMMAND} {declared.next} {quote(called)}"
        name = "study"
        if declared.next != "report":
            name = declared.next
        command = f"{PROGRAM_COMMAND} {name} {subject.words}"
        if cut := values.get(UP_TO):
            command += f" {flag_of(UP_TO)} {quote(cut)}"
        return command

    def command_line(
        self,
        subjects: Sequence[str],
        part: Mapping[str, str | bool | None],
        values: JsonObject,
    ) -> str:
        """The command line that asks this question. It has a flag for each option whose value is
        not the default, and for each value of `part` that is stated.
        """
        words = [PROGRAM_COMMAND, self.name, *map(quote, subjects)]
        for name, option in self.options.items():
            value = values.get(name, option.default)
            # A command names a file of cars, because a table does not fit into it.
            if option.metavar == CARS_FILE and not isinstance(value, str | Path | None):
                value = CARS_FILE
            if value == option.default:
                continue
            if option.kind is bool or value == "":
                words.append(option.flag)
                continue
            for text in value if option.is_repeated else [value]:
                words += [option.flag, quote(str(text))]
        for name, stated in part.items():
            if stated:
                words.append(flag_of(name))
            if isinstance(stated, str):
                words.append(quote(stated))
        return " ".join(words)


COMMON_OPTIONS = options_of(Question.__call__)
"""Options that every question has, by name."""
SIMULATIONS = COMMON_OPTIONS["simulations"]
"""The option that pages and packs of evidence have for their questions, too."""


def question(compute: Callable[..., Answer]) -> Question:
    """Decorator that makes a question of a function `(subject, evaluator, *, options) -> Answer`.

    The function's signature states the defaults of the options, `Annotated` types state their
    ranges, and the numpydoc docstring explains them. If the first parameter has the type `Results`,
    the question takes only results. Each further positional parameter is a further subject, or a
    file if its type is `Path`.
    """
    if not callable(compute):
        raise InputError("question()", repr(compute), "a function")
    return Question(compute)


def find_question(name: str) -> Question:
    """The question with a name: a question of this package or, as `module:name`, of the user.

    Raises
    ------
    InputError
        If there is no such question.
    """
    legal = f"{', '.join(QUESTIONS)}, or module:name of a function with @question"
    unknown = InputError("question", f"there is no {name!r}", legal)
    if ":" in name:
        module, _, function = name.partition(":")
        # The user's module may be in the working directory, which is not on the path of an
        # installed program.
        add_import_folders(())
    elif name in QUESTIONS:
        module, function = QUESTIONS[name], name
    else:
        raise unknown
    # Python's caches of folders would hide a module that was written a moment ago.
    invalidate_caches()

    try:
        with user_errors(name):
            imported = import_module(module)
    except ModuleNotFoundError:
        raise unknown from None
    questions = {
        name: value
        for name, value in vars(imported).items()
        if isinstance(value, Question)
    }
    if function not in questions:
        raise unknown_name(
            "question",
            f"{module} has no function {function!r} with @question",
            function,
            questions,
        )
    return questions[function]


def _name(source: StudyLike | Results) -> str:
    """The name of a subject on the command line: a directory of results, or a study."""
    from safevar_sumo.questions.case import Results

    if isinstance(source, Results):
        return str(source.directory)
    if isinstance(source, Study):
        return source.origin.called or source.name
    return str(source)
