"""Every question is one function `(subject, evaluator, *, options) -> Answer`; here it becomes a
call of the library.

The command line makes its command from the same signature and docstring (`cli/command.py`), as of
every other public function.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, update_wrapper
from importlib import import_module, invalidate_caches
from numbers import Integral, Real
from pathlib import Path
from shlex import quote, split
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args, get_origin

from rich.console import Console

from safevar_sumo.errors import MAX_JOBS, InputError, check_name, check_text, unknown_name, warn
from safevar_sumo.metrics import Unsafe
from safevar_sumo.plugins import add_import_folders
from safevar_sumo.plugins.contract import user_errors
from safevar_sumo.questions.subject import Results, part_of, study_in, study_or_case
from safevar_sumo.records import JsonObject
from safevar_sumo.shipped import PACKAGE, PROGRAM_COMMAND
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.terminal import Parts, Progress, open_progress, print_text

if TYPE_CHECKING:
    from safevar_sumo.campaign.pool import Pool
    from safevar_sumo.questions.answer import Answer
    from safevar_sumo.questions.case import Subject
    from safevar_sumo.questions.evaluator import Evaluator

QUESTIONS = {
    name: f"safevar_sumo.questions.{name}"
    for name in ("compare", "explain", "permit", "rating", "repair", "risk", "rules", "tolerance")
} | {"validate": "safevar_sumo.reference.agreement"}
"""The module of each question, whose function has the question's name."""


class Range(NamedTuple):
    """The range of a number; `is_open` leaves out its ends."""

    low: float
    high: float
    is_open: bool = False

    def __contains__(self, value: object) -> bool:
        assert isinstance(value, Real)
        number = float(value)
        return self.low < number < self.high if self.is_open else self.low <= number <= self.high

    def __str__(self) -> str:
        before, between = ("between", "and") if self.is_open else ("from", "to")
        ends = [
            f"{end:,}" if isinstance(end, int) else f"{end:,.12g}" for end in (self.low, self.high)
        ]
        return f"{before} {ends[0]} {between} {ends[1]}"


Count = Annotated[int, Range(1, 100_000_000)]
"""A number of vehicles, solutions or attempts."""
Fraction = Annotated[float, Range(0, 1, is_open=True)]
"""A share such as a confidence."""
Margin = Annotated[float | None, Range(0, 100)]
"""A distance to keep from a collision [m]."""
CRITERION = '"METRIC < X"|collision|below=X|points=X'
Criterion = Annotated[str | None, CRITERION]
"""What is unsafe: a collision, a safety degree below X [m], at most X points of a rating, or a
metric of the study with <, <=, > or >= and a number; by default a collision if any evaluated
setting collides, else half of the original's safety degree; of a rated study, any point lost.
"""
CARS_FILE = "FILE.csv"
"""A list of cars: its path, or in the library also a DataFrame or a mapping."""
LimitTexts = Annotated[tuple[str, ...], '"NAME >= X"']
"""Limits of characteristics."""
ValueTexts = Annotated[tuple[str, ...], "NAME=VALUE"]
"""Values of characteristics."""
Fits = Annotated[int | None, Range(0, 1000)]
"""A number of parameter sets; None for all."""
PointName = Annotated[str | None, "NAME"]
"""A test, or a point, of a study's matrix."""
UpTo = Annotated[str | None, "NAME=V"]
"""A value at which an axis ends."""
Jobs = Annotated[int | None, Range(1, MAX_JOBS)]
"""A number of worker processes."""
Cluster = Annotated[str | None, "ADDRESS"]
"""The address of a Dask scheduler."""
UP_TO = "up_to"
"""The option that cuts an axis."""
QUICK = "quick"
"""The option of questions that have a rough answer, too."""
ROUGH = (
    "Rough answer (--quick: the study's own parameter set alone, and a short search; it proves"
    " nothing):"
)
"""The beginning of such an answer."""
Simulations = Annotated[int | None, Range(1, 1_000_000_000)]
"""The largest number of simulations."""
COMMON_OPTIONS = (
    ("point", PointName, None, "Only this test, or this point, of the study's matrix."),
    (
        "ranges",
        bool,
        False,
        "Any encounter in the ranges of the study's axes, not the tests alone.",
    ),
    ("up_to", UpTo, None, "Only encounters up to this value of an axis, such as speed=40."),
    ("jobs", Jobs, None, "Number of worker processes, by default one for each core."),
    ("cluster", Cluster, None, "Compute on the workers of this Dask scheduler instead."),
    (
        *("simulations", Simulations, None),
        (
            "At most so many simulations: a rough answer where more are usual. By default, as many"
            " as take 15 minutes where a simulation takes long."
        ),
    ),
    ("pool", Any, None, "Pool that simulates; by default new worker processes."),
    (
        "progress",
        Any,
        False,
        "True for a bar on the terminal, or a function of a phase, the number of simulations done,"
        " and their total.",
    ),
    (
        *("as_it_is_now", bool, False),
        (
            "If results were computed with other files or versions, simulate with the present ones"
            " and say so."
        ),
    ),
    (
        *("fresh", bool, False),
        "Simulate everything anew, instead of reading what earlier commands have simulated.",
    ),
)
"""Options that every question has: name, type, default, and meaning."""


def flag_of(name: str) -> str:
    """The flag of an option."""
    return f"--{name.replace('_', '-')}"


class Option(NamedTuple):
    """An option of a function: the type of a value, its range, choices or the form of its text, its
    default and its meaning.
    """

    name: str
    kind: type
    limits: Range | None
    choices: tuple[str, ...]
    metavar: str | None
    is_repeated: bool
    default: Any
    meaning: str

    @property
    def flag(self) -> str:
        return flag_of(self.name)

    def check(self, value: Any) -> Any:
        """The value, of a repeated option a tuple, a mapping as texts NAME=VALUE; refuses what has
        another type or is outside the range.
        """
        # A table NAME=VALUE, a text, or several.
        if self.is_repeated:
            if isinstance(value, Mapping):
                value = [f"{name}={inner}" for name, inner in value.items()]
            values = (value,) if isinstance(value, str) else tuple(value)
            if twice := next((text for text in values if values.count(text) > 1), None):
                raise InputError(self.name, f"{twice!r} is given twice", "each value once")
            return values
        is_object = self.metavar == CARS_FILE and not isinstance(value, str)
        if value is None or is_object or self.kind is bool or self.metavar == CRITERION:
            return value
        if self.kind not in (int, float):
            return check_text(self.name, value)

        # A number within its limits.
        number, words = (Integral, "a whole number") if self.kind is int else (Real, "a number")
        words = f"{words} {self.limits}" if self.limits else words
        if (
            isinstance(value, bool)
            or not isinstance(value, number)
            or (self.limits and value not in self.limits)
        ):
            raise InputError(self.name, repr(value), words)
        return value


SIMULATIONS = Option(
    "simulations", int, get_args(Simulations)[1], (), None, False, None, "the largest number"
)
"""The option that questions on pages and in packs have, too."""


class Question:
    """A question as a function of the library: `risk("rain", samples=1000)`."""

    def __init__(self, compute: Callable[..., Answer]) -> None:
        # Its name, as in commands.
        update_wrapper(self, compute)
        is_own = compute.__module__.partition(".")[0] == PACKAGE.name
        self.compute = compute
        self.name = f"{'' if is_own else f'{compute.__module__}:'}{compute.__name__}"

        # Its parameters: what it is about, and options.
        parameters = list(inspect.signature(compute).parameters.values())
        if (
            sum(
                parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
                for parameter in parameters
            )
            < 2
        ):
            raise InputError(
                f"question {self.name!r}",
                f"takes ({', '.join(map(str, parameters))})",
                "(subject, evaluator), then other subjects, * and options",
            )
        self.takes_results_only = str(parameters[0].annotation) == "Case"
        self.others = {
            parameter.name: str(parameter.annotation) == "Path"
            for parameter in parameters[2:]
            if parameter.kind is not parameter.KEYWORD_ONLY
        }
        """Further positional parameters, and whether each is a file instead of a subject."""
        # Options that all questions have.
        own = inspect.signature(compute).parameters
        further = [option for option in COMMON_OPTIONS if option[0] not in own]
        common = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind
            )
            for name, kind, default, _ in further
        ]
        shown = [parameters[0], *(parameter for parameter in parameters[2:]), *common]
        self.__signature__ = inspect.Signature(shown, return_annotation="Answer")
        texts = "\n".join(f"{name}\n    {text}" for name, _, _, text in further)
        self.__doc__ = f"{inspect.cleandoc(compute.__doc__ or '')}\n{texts}"

    @cached_property
    def options(self) -> list[Option]:
        """The options by signature and docstring, without those that all questions have."""
        return options_of(self.compute)

    @property
    def has_rough_answer(self) -> bool:
        """Whether `--quick` asks for a rough answer."""
        return any(option.name == QUICK for option in self.options)

    def __call__(
        self,
        source: StudyLike | Results | None = None,
        *others: StudyLike | Results,
        point: str | None = None,
        ranges: bool = False,
        up_to: str | None = None,
        jobs: int | None = None,
        cluster: str | None = None,
        simulations: int | None = None,
        pool: Pool | None = None,
        progress: bool | Progress = False,
        as_it_is_now: bool = False,
        fresh: bool = False,
        **values: Any,
    ) -> Answer:
        # Where the question itself cuts encounters, it gets the whole of them.
        is_own = any(option.name == UP_TO for option in self.options)
        cut, values = (None, {**values, UP_TO: up_to}) if is_own else (up_to, values)
        # Options that it has, with legal values.
        known = {option.name: option for option in self.options}
        for name in values.keys() - known.keys():
            raise TypeError(f"{self.name}() got an unexpected keyword argument {name!r}")
        if source is None or len(others) != len(self.others):
            names = ["source", *self.others]
            raise InputError(f"{self.name}()", f"takes exactly {' and '.join(names)}")
        values = {name: known[name].check(value) for name, value in values.items()}

        def subject_of(source: StudyLike | Results) -> Subject:
            subject = study_or_case(
                source, as_it_is_now=as_it_is_now, results_only=self.takes_results_only
            )
            shortfall = "" if isinstance(subject, Study) else subject.shortfall
            if shortfall:
                warn(shortfall)
            return part_of(subject, ranges, point, cut)

        from safevar_sumo.campaign.cache import keep_simulations  # SUMO takes long to load

        # What it is about, as studies, results or files.
        cuts = {"point": point, "up_to": cut}
        named = [_name(source), *map(_name, others)]
        command = self.command_line(named, cuts, values, ["--ranges"] * ranges)
        how: JsonObject = {"pool": pool, "jobs": jobs, "simulations": simulations}
        how |= {"cluster": cluster, "as_it_is_now": as_it_is_now}
        subjects: list[Any] = [subject_of(source)]
        for other, is_file in zip(others, self.others.values(), strict=True):
            subjects.append(Path(str(other)) if is_file else subject_of(other))
        with keep_simulations(command, fresh=fresh):
            # A rough answer, which comes much earlier, may be shown before the answer.
            is_long = (
                self.has_rough_answer
                and not any(values.get(name) for name in (QUICK, "out"))
                and simulations is None
            )
            if is_long and progress is True and sys.stderr.isatty():
                with open_progress(True) as show:
                    part = Parts(show).begin("rough answer")
                    first = self.answer(subjects, {**values, "quick": True}, **how, progress=part)
                print_text(Console(stderr=True), f"{first.verdict}\n")
            answer = self.answer(subjects, values, **how, progress=progress, called=_name(source))
        return replace(answer, command=command + answer.command)

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
        """The answer about subjects that have been loaded, and files; `values` are those of
        options. The command that comes next is about the first subject as it is `called`. The
        answer's own command is the end of its command line: how many simulations it may do. It is
        one of so many `questions` that share the time.
        """
        from safevar_sumo.questions.answer import Answer
        from safevar_sumo.questions.case import Case
        from safevar_sumo.questions.evaluator import open_evaluator  # SUMO takes long to load
        from safevar_sumo.questions.measure import subject_by

        # Simulations by the criterion that is asked for.
        study = study_in(subjects[0])
        with (
            open_progress(progress) as show,
            open_evaluator(study, pool, jobs, show, cluster) as evaluator,
        ):
            account = evaluator.account
            evaluator.limit(simulations)
            account.questions = questions
            for subject in subjects:
                if isinstance(subject, Case) and not as_it_is_now:
                    evaluator.for_study(subject.study).refuse_other_original(subject)
            criterion, values, cites = self._criterion(values, study)
            if criterion is not None:
                unsafe = Unsafe.parse(criterion)
                subjects = [subject_by(subject, unsafe, evaluator) for subject in subjects]
                study = study_in(subjects[0])
                evaluator = evaluator.for_study(study)
                if unsafe.bound:
                    account.measure = unsafe.bound.measure
                    evaluator.check_measured(account.measure)

            # The question's own function.
            with user_errors(self.name):
                answer = self.compute(subjects[0], evaluator, *subjects[1:], **values)
            if not isinstance(answer, Answer):
                raise InputError(self.name, f"returns {type(answer).__name__}", "an Answer")

            # An answer about a driving system that fails by itself begins with that.
            about = evaluator if answer.study is study else evaluator.for_study(answer.study)
            reason = about.no_verdict
            evaluator.end()
        numbers = {"driven": not reason, **answer.numbers}
        rough = ROUGH if values.get(QUICK) else ""
        if account.most is not None:
            numbers |= {"rough": True, "simulations": account.spent}
            rough = f"Rough answer (--simulations {account.most}):"
        if self.has_rough_answer:
            numbers["rough"] = bool(rough or numbers.get("rough"))
        sentences = reason, rough, answer.verdict, cites, account.undefined_in_words
        verdict = " ".join(filter(None, sentences))
        following = self._following(subjects[0], evaluator, called, values) or answer.next
        most = account.asked if account.most is None else account.most
        command = "" if most is None else f" --simulations {most}"
        return replace(answer, verdict=verdict, numbers=numbers, next=following, command=command)

    def _criterion(self, values: JsonObject, study: Study) -> tuple[Any, JsonObject, str]:
        """What is unsafe, the values of options with it, and where it comes from: a study's own
        criterion stands where nothing else is asked for; a margin is that of a collision.
        """
        option = next((one.name for one in self.options if one.metavar == CRITERION), "")
        if not option or any(values.get(name) is not None for name in (option, "margin")):
            return values.get(option), values, ""
        own = study.unsafe
        cites = (
            f"Criterion: {own.criterion or None} ({own.source})." if own.source else "",
            f"Not simulated: {own.not_simulated}." if own.not_simulated else "",
        )
        criterion = own.criterion or None
        return criterion, {**values, option: criterion}, " ".join(filter(None, cites))

    def _following(
        self, subject: Subject, evaluator: Evaluator, called: str, values: JsonObject
    ) -> str:
        """The command that comes next, if it has an answer: the page is about results of `study`,
        and where nobody else is on the road nothing is unsafe by itself.
        """
        from safevar_sumo.questions.answer import contents_of

        declared = contents_of(self.compute)
        if not (declared and declared.next and called) or (
            evaluator.system.meets_nobody and not evaluator.study.unsafe.criterion
        ):
            return ""
        is_too_early = declared.next == "report" and isinstance(subject, Study)
        words = subject.words if isinstance(subject, Study) else quote(called)
        cut = values.get(UP_TO) if isinstance(subject, Study) else None
        words += f" {flag_of(UP_TO)} {quote(cut)}" if cut else ""
        return f"{PROGRAM_COMMAND} {'study' if is_too_early else declared.next} {words}"

    def command_line(
        self,
        subjects: Sequence[str],
        part: Mapping[str, str | None],
        values: JsonObject,
        flags: Sequence[str] = (),
    ) -> str:
        """The command that asks this question; it has a flag for each option that is not at its
        default.
        """
        words = [PROGRAM_COMMAND, self.name, *map(quote, subjects)]
        for option in self.options:
            value = values.get(option.name, option.default)
            if option.metavar == CARS_FILE and not isinstance(value, str | Path | None):
                value = CARS_FILE  # a table's contents are none of the command's
            if value == option.default:
                continue
            texts = [""] if option.kind is bool else value if option.is_repeated else [value]
            words += [
                f"{option.flag} {quote(str(text))}".strip() if text != "" else option.flag
                for text in texts
            ]
        words += [
            *flags,
            *(f"{flag_of(name)} {quote(str(text))}" for name, text in part.items() if text),
        ]
        return " ".join(words)


def question(compute: Callable[..., Answer]) -> Question:
    """Decorator: makes a function `(subject, evaluator, *, options) -> Answer` a question.

    Defaults are those of its signature, ranges those of `Annotated` types, texts those of its
    numpydoc docstring. A first parameter of type `Case` takes results only; further positional
    parameters are further subjects, of type `Path` files.
    """
    return Question(compute)


def find_question(name: str) -> Question:
    """A question of this package, or one of the user's as `module:name`.

    Raises
    ------
    InputError
        If there is no such question.
    """
    # A question of this package, or of the user's.
    legal = f"{', '.join(QUESTIONS)}, or module:name of a function with @question"
    if not (":" in name or name in QUESTIONS):
        raise InputError("question", f"there is no {name!r}", legal)
    module, _, function = name.partition(":") if ":" in name else (QUESTIONS[name], "", name)
    if ":" in name:
        add_import_folders(
            ()
        )  # the working directory, which an installed program does not have on its path
    invalidate_caches()  # the module may have been written a moment ago

    # Its module has a function with the decorator.
    try:
        with user_errors(name):
            imported = import_module(module)
    except ModuleNotFoundError:
        raise InputError("question", f"there is no {name!r}", legal) from None
    found = getattr(imported, function, None)
    if not isinstance(found, Question):
        known = [name for name, value in vars(imported).items() if isinstance(value, Question)]
        raise unknown_name(
            "question", f"{module} has no function {function!r} with @question", function, known
        )
    return found


def options_of(function: Callable[..., Any]) -> list[Option]:
    """The options of a function: its keyword-only parameters, as signature and numpydoc docstring
    describe them.
    """
    pattern = re.compile(r"^(\w+)\n((?:    .*\n?)+)", re.MULTILINE)
    texts = dict(pattern.findall(inspect.cleandoc(function.__doc__ or "")))
    names = inspect.unwrap(function).__globals__
    options = []
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            hint = parameter.annotation  # a text where the module postpones annotations
            meaning = " ".join(texts.get(parameter.name, "").split())
            options.append(
                _option(parameter, eval(hint, names) if isinstance(hint, str) else hint, meaning)
            )
    return options


def parse_question(text: str) -> tuple[Question, JsonObject]:
    """A question and values of its options, from its command without subjects: `risk --samples
    4000`.

    Raises
    ------
    InputError
        If there is no such question or option, or a value is not allowed.
    """
    # The question's name.
    try:
        name, *words = split(text)
    except ValueError:  # nothing, or a quotation mark without its second one
        raise InputError(
            "ask", repr(text), 'a question with its options, such as "risk --samples 4000"'
        ) from None
    asked = find_question(name)

    # Options, each with its value.
    values = dict[str, Any]()
    waiting = iter(words)
    options = {option.flag: option for option in (*asked.options, SIMULATIONS)}
    for flag in waiting:
        check_name("ask", f"{name} has no option {flag!r}", flag, options)
        option = options[flag]
        if option.name in values and not option.is_repeated:
            raise InputError(f"ask: {name} {flag}", "is given twice", "it once")
        value = option.kind is bool or next(waiting, None)
        try:
            value = value if option.kind is bool else option.kind(value)
        except (TypeError, ValueError):
            raise InputError(f"ask: {name} {flag}", repr(value), option.kind.__name__) from None
        values[option.name] = option.check(
            (*values.get(option.name, ()), value) if option.is_repeated else value
        )
    return asked, values


def with_criterion(text: str, unsafe: str | None) -> str:
    """A question as `parse_question` reads it, with a criterion if it takes one and states none."""
    asked, values = parse_question(text)
    takes_it = unsafe is not None and any(option.metavar == CRITERION for option in asked.options)
    return f"{text} --unsafe {quote(str(unsafe))}" if takes_it and "unsafe" not in values else text


def quick_questions(texts: Sequence[str]) -> list[str]:
    """The questions, rough where they can be."""
    found = []
    for text in texts:
        asked, values = parse_question(text)
        is_made_rough = asked.has_rough_answer and QUICK not in values
        found.append(f"{text} --{QUICK}" if is_made_rough else text)
    return found


def _option(parameter: inspect.Parameter, hint: Any, meaning: str) -> Option:
    limits = None
    metavar = None
    if get_origin(hint) is Annotated:
        hint, extra = get_args(hint)
        limits, metavar = (extra, None) if isinstance(extra, Range) else (None, str(extra))
    is_repeated = any(get_origin(kind) is tuple for kind in (hint, *get_args(hint)))
    kinds = [kind for kind in (bool, int, float, Path) if kind is hint or kind in get_args(hint)]
    kind = str if is_repeated or not kinds else kinds[0]
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    return Option(
        parameter.name, kind, limits, choices, metavar, is_repeated, parameter.default, meaning
    )


def _name(source: StudyLike | Results) -> str:
    """How a command line names a subject."""
    if isinstance(source, Results):
        return str(source.directory)
    return source.origin.called or source.name if isinstance(source, Study) else str(source)


def has_criterion(text: str, unsafe: str | None) -> bool:
    """Whether a question as `with_criterion` gives it is asked by a criterion, and not by another
    one or none.
    """
    return parse_question(text)[1].get("unsafe") == (None if unsafe is None else str(unsafe))
