"""Evidence that anybody can compute again: `evidence` packs results with their page and answers;
`verify` computes everything anew from the pack alone, in a fresh folder, and compares.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import msgspec

from safevar_sumo.campaign.cache import keep_simulations, simulate_anew
from safevar_sumo.campaign.pool import open_pool
from safevar_sumo.errors import InputError, describe_error
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import check_writable, temporary_folder
from safevar_sumo.plugins import (
    code_files,
    file_by_name,
    is_of_shipped_network,
    only_from,
)
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import SIMULATIONS, Criterion
from safevar_sumo.questions.by_criterion import cases_by
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.options import Cluster, Jobs, Simulations
from safevar_sumo.questions.permit.fleet import list_without_names
from safevar_sumo.questions.sentence import Verdict, answer
from safevar_sumo.questions.subject import study_or_case
from safevar_sumo.questions.tables import tabulate
from safevar_sumo.questions.words import count_in_words
from safevar_sumo.records import JsonObject
from safevar_sumo.report.claims import (
    ANSWERS,
    CANNOT,
    CLAIMS,
    CODE,
    DIFFERS,
    FILES,
    LISTS,
    MALFORMED,
    PAGE,
    SAME,
    STUDY,
    UNCHECKED,
    VERDICTS,
    Claim,
    Packed,
    compare_claim,
    count_outcomes,
    count_solutions,
    csv_of,
    json_bytes,
    list_in,
    packed_answer,
    with_list,
)
from safevar_sumo.report.pack import (
    DESCRIPTION,
    PACK,
    Description,
    PackedManifest,
    PackedStudy,
    digest_of,
    digests_of,
    json_of,
    read_pack,
    versions_here,
    write_pack,
)
from safevar_sumo.report.page import (
    parts_of_simulations,
    usual_questions,
    with_speed_part,
)
from safevar_sumo.report.texts import parse_question
from safevar_sumo.results import MANIFEST, SOLUTIONS, changed_values, read_manifest
from safevar_sumo.study import Study, data_files, fmus_of, tables_of
from safevar_sumo.sumo.network import OPTIONS_FILE, options_in
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Parts, Progress, open_progress, show_no_progress


def evidence(
    *results: str | Path,
    out: Path,
    ask: tuple[str, ...] = (),
    unsafe: Criterion = None,
    jobs: Jobs = None,
    cluster: Cluster = None,
    progress: bool | Progress = False,
    fresh: bool = False,
    simulations: Simulations = None,
) -> str:
    """Pack results with their study, page and answers into one file (an evidence pack), so that
    anybody can compute every number again. `verify` computes the numbers again and reports each
    difference. The evidence pack does not contain the names of cars.

    Example: python -m safevar_sumo evidence results/rain --out pack.zip

    Parameters
    ----------
    results
        Results, or their directories.
    out
        File to write the evidence pack to. The name ends in .zip.
    ask
        Ask this question in place of the usual ones, such as "risk --samples 4000"; may be
        repeated.
    unsafe
        Criterion for an unsafe vehicle in every answer of the pack, such as collision or "drac >
        6". Default: the criterion of the study, else a collision.
    jobs
        Number of worker processes. Default: one for each processor core.
    cluster
        Simulate on the workers of this Dask scheduler, such as tcp://host:8786. Default: on this
        machine.
    progress
        True for a bar on the terminal, or a function of a phase, what is done, and the total.
    fresh
        Simulate everything again. Default: use simulations of earlier commands again.
    simulations
        Largest number of simulations of all questions and replays of the pack together.

    Returns
    -------
    str
        The pack's path, size and sha256.

    Raises
    ------
    InputError
        If a directory holds no results, its inputs have changed, or there is no such question.
    """
    SIMULATIONS.check(simulations)
    out = Path(out)
    check_writable(out, "out", (".zip",))

    command = f"evidence {results} {ask} {unsafe}"
    workers = {"jobs": jobs, "cluster": cluster}
    directories = dict.fromkeys(Path(result) for result in results)
    studies = []
    files = {}
    with open_progress(progress) as show, keep_simulations(command, fresh=fresh):
        for number, directory in enumerate(directories, 1):
            part = simulations and simulations // len(directories)
            packed_study, study_files = _pack_study(
                number, directory, ask, unsafe, workers, show, part
            )
            studies.append(packed_study)
            for name, content in study_files.items():
                files[f"{packed_study.folder}/{name}"] = content
    write_pack(out, studies, files)
    return (
        f"The pack is {out} ({out.stat().st_size / 1e6:.2f} MB). The SHA-256 digest of the pack is"
        f" {digest_of(out)}."
    )


def _pack_study(
    number: int,
    directory: Path,
    ask: Sequence[str],
    unsafe: Unsafe | None,
    workers: JsonObject,
    progress: Progress,
    simulations: int | None,
) -> tuple[PackedStudy, dict[str, bytes]]:
    """Describe results as a study of a pack. Returns the description, and the contents of the
    study's files by name.
    """
    case = study_or_case(directory, results_only=True)
    assert isinstance(case, Results)
    if not case.has_runs:
        raise InputError(
            directory,
            "holds imported solutions, which have no identity",
            "results of `study`",
        )
    study = case.study
    # A pack keeps only keys of the manifest that `verify` compares or names.
    stored = {**read_manifest(directory), "study": tables_of(study)}
    manifest = {
        name: stored[name]
        for name in PackedManifest.__struct_fields__
        if name in stored
    }

    (judged,) = cases_by([case], unsafe, progress=show_no_progress, **workers)
    questions, lists = _with_lists(list(dict.fromkeys(ask or usual_questions(judged))))
    folder = f"{number}-{study.name}"
    runs = list(case.finished)
    (parts,) = parts_of_simulations(
        [case], [judged], None, [with_speed_part(questions, case)], simulations
    )
    described = PackedStudy(
        folder,
        questions,
        runs,
        count_outcomes(case),
        count_solutions(case.solutions, runs),
        str(unsafe) if unsafe else None,
        parts,
    )

    files = {
        MANIFEST: json_bytes(manifest),
        SOLUTIONS: csv_of(case.solutions),
        **lists,
        **_files_of_user(study, manifest["files"], questions),
    }
    show_part = Parts(progress).begin(study.name)
    with open_pool(**workers) as pool:
        if simulations and assemble(study).mover.takes_long:
            pool.shared = {}
        packed = Packed(
            described, files, study.origin.places, workers["jobs"], show_part, pool
        )
        answers = json_bytes([packed_answer(packed.answer(text)) for text in questions])
        packed.ask_speed()
        opened = dict.fromkeys(chain(*pool.opened.values()))
    packed.pool = None
    files |= _files_of_user(study, opened, [])
    files |= {STUDY: packed.study_file(), ANSWERS: answers, PAGE: packed.page()}
    return msgspec.structs.replace(described, simulations=packed.simulations()), files


def _with_lists(questions: Sequence[str]) -> tuple[list[str], dict[str, bytes]]:
    """The questions, in which lists of cars have their names in the pack; and the contents of these
    lists, without the names of cars.
    """
    packed = []
    lists = dict[str, bytes]()
    for text in questions:
        path = list_in(text)
        if not path:
            packed.append(text)
            continue
        name = f"{LISTS}/{len(lists) + 1}.csv"
        _, options = parse_question(text)
        lists[name] = list_without_names(Path(path), options.get("ignore", ()))
        packed.append(with_list(text, name))
    return packed, lists


def _files_of_user(
    study: Study, named: Iterable[str], questions: Sequence[str]
) -> dict[str, bytes]:
    """The contents of the user's files by their names in a pack: files on which the results depend
    (`named`), code of the user's questions, and views of networks.
    """
    places = study.origin.places
    names = [name for name in named if not is_of_shipped_network(name)]
    # Files are found by their places beside the study: a file elsewhere would be missing in a pack.
    outside = []
    for name in (*data_files(study), *dict(fmus_of(study)).values()):
        path_beside = os.path.abspath(Path(places[0], name))
        if not Path(path_beside).is_relative_to(places[0]):
            outside.append(path_beside)
    for name in [*outside, *(name for name in names if os.path.isabs(name))]:
        raise InputError(
            name,
            "lies outside the study's folders, so that no pack can hold it",
            "a copy beside the study, which then names the copy",
        )

    # SUMO does not start without the views that a network names.
    for name in names[:]:
        if Path(name).name == OPTIONS_FILE:
            options = options_in(Path(file_by_name(name, places)))
            view = options.get("gui-settings-file")
            if view:
                names.append(str(Path(name).with_name(view)))
    paths = {}
    for name in names:
        place = file_by_name(name, places)
        if place:
            paths[name] = Path(place)

    modules = [
        text.partition(":")[0] for text in questions if ":" in text.partition(" ")[0]
    ]
    folders = [folder for folder in (*places, os.getcwd(), *sys.path) if folder]
    for path in code_files(modules, places):
        folder = max(
            (folder for folder in folders if path.is_relative_to(folder)), key=len
        )
        paths[path.relative_to(folder).as_posix()] = path
    return {f"{CODE}/{name}": path.read_bytes() for name, path in sorted(paths.items())}


@contents(
    "passed",
    "sha256",
    "claims",
    "same",
    "differs",
    "cannot",
    "unchecked",
    claims=CLAIMS,
)
def verify(
    pack: str | Path,
    *,
    search: bool = False,
    run_code: bool = False,
    jobs: Jobs = None,
    progress: bool | Progress = False,
) -> Answer:
    """Compute every claim of an evidence pack again, and compare the result with the claim. The
    exit code is 0 if all claims are confirmed, and 1 if a claim differs. Exit code 2 means that the
    evidence pack is damaged or was written by another version.

    Example: python -m safevar_sumo verify pack.zip

    Parameters
    ----------
    pack
        The pack.
    search
        Repeat the whole search as well. Default: simulate only the original vehicle and the
        solutions again, and ask the questions again.
    run_code
        Run user code that the pack contains or names. Default: a pack with user code is an
        error, and no code is run.
    jobs
        Number of worker processes. Default: one for each processor core.
    progress
        True for a bar on the terminal, or a function of a phase, what is done, and the total.

    Raises
    ------
    InputError
        If the pack is damaged, of another version, or holds user code and `run_code` is false.
    """
    path = Path(pack).absolute()
    description, files = read_pack(path)
    with temporary_folder() as folder, open_progress(progress) as show, simulate_anew():
        studies = {}
        for number, described in enumerate(description.studies):
            place = Path(folder, str(number))
            studies[place] = _unpack(path, described, files, place, jobs, show)
        _refuse_files_without_study(path, files, studies.values())
        if not run_code:
            _refuse_code(path, studies.values())

        names = ", ".join(packed.case.study.name for packed in studies.values())
        files_claim = Claim(
            "files",
            json_bytes(description.files),
            lambda: json_bytes(digests_of(files)),
        )
        verdicts = [compare_claim(names, files_claim)]
        for place, packed in studies.items():
            with only_from(str(place / CODE)):
                for claim in packed.claims(place, search):
                    verdicts.append(compare_claim(packed.case.study.name, claim))

    rows = [verdict._asdict() for verdict in verdicts]
    claims = tabulate("Claims", CLAIMS, rows)
    counts = Counter(claims.frame["verdict"])
    sentences = _count_sentences(counts)
    if claims.frame["verdict"][0] == DIFFERS:
        sentences.insert(0, ALTERED)
    parts = _not_compared(description, studies.values())
    if counts[UNCHECKED]:
        parts.append("how many simulations had which outcome (--search compares it)")
    if parts:
        sentences.append(f"These parts were not compared: {'; '.join(parts)}.")
    return Answer(
        question="verify",
        study=next(iter(studies.values())).case.study,
        verdict=Verdict(answer(sentence) for sentence in sentences),
        numbers={
            "passed": counts[SAME] + counts[UNCHECKED] == len(rows),
            "sha256": digest_of(path),
            "claims": len(rows),
            **{verdict.partition(" ")[0]: counts[verdict] for verdict in VERDICTS},
        },
        tables={"claims": claims},
    )


ALTERED = "This pack was altered: its files are not those that its description lists."
"""The first sentence about a pack whose files have other digests than the pack states."""


def _refuse_files_without_study(
    pack: Path, files: dict[str, bytes], studies: Iterable[Packed]
) -> None:
    """Refuse a pack that holds a file of none of its studies."""
    unknown = {*files}
    for packed in studies:
        unknown -= {f"{packed.packed.folder}/{name}" for name in packed.files}
    if unknown:
        raise InputError(pack, f"{min(unknown)} belongs to no study", PACK)


def _refuse_code(pack: Path, studies: Iterable[Packed]) -> None:
    """Refuse a pack with user code: such code runs only if the user trusts it."""
    code = [name for packed in studies for name in packed.code]
    if code:
        raise InputError(
            pack,
            f"`verify` would run code of the pack: {', '.join(code)}",
            "`run_code=True`, if you trust it",
        )


def _count_sentences(counts: Counter[str]) -> list[str]:
    """Sentences on the numbers of claims with each verdict."""
    number = counts.total()
    confirmed = count_in_words(counts[SAME], number).capitalize()
    sentences = [f"{confirmed} claims of the pack are confirmed."]
    if counts[DIFFERS]:
        sentences.append(f"{counts[DIFFERS]} of the {number} claims differ.")
    if counts[CANNOT]:
        sentences.append(
            f"{counts[CANNOT]} of the {number} claims cannot be computed here."
        )
    return sentences


def _not_compared(description: Description, studies: Iterable[Packed]) -> list[str]:
    """Phrases on values of a pack that `verify` does not compare, and that differ from this
    machine: versions and platforms. `verify` compares the results, and need not compare these.
    """
    pairs = {
        DESCRIPTION: ({"versions": description.versions}, {"versions": versions_here()})
    }
    pairs |= {
        f"{packed.packed.folder}/{MANIFEST}": packed.versions for packed in studies
    }
    return [
        f"{key} of {file}: {stated} ({present} here)"
        for file, versions in pairs.items()
        for key, stated, present in changed_values(*versions)
    ]


def _unpack(
    path: Path,
    described: PackedStudy,
    files: dict[str, bytes],
    folder: Path,
    jobs: int | None,
    progress: Progress,
) -> Packed:
    """Read one study of a pack, and write its manifest and the user's files into `folder`.

    Raises
    ------
    InputError
        If the study is damaged.
    """
    prefix = f"{described.folder}/"
    own_files = {
        name.removeprefix(prefix): content
        for name, content in files.items()
        if name.startswith(prefix)
    }
    code = [name for name in own_files if name.startswith(f"{CODE}/")]
    lists = [name for name in own_files if name.startswith(f"{LISTS}/")]

    # Anybody may have edited a pack: all files are checked before any of them is used.
    try:
        for name in sorted(FILES ^ (own_files.keys() - {*code, *lists})):
            problem = "belongs to no claim" if name in own_files else "is missing"
            raise ValueError(f"{name} {problem}")
        (folder / CODE).mkdir(parents=True)
        for name in (MANIFEST, *code):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(own_files[name])
        for name in FILES:
            own_files[name].decode()
        if len(json_of(own_files[ANSWERS])) != len(described.questions):
            raise ValueError(
                f"{ANSWERS} answers other questions than {DESCRIPTION} names"
            )
        for name in json_of(own_files[MANIFEST])["files"]:
            if not (is_of_shipped_network(name) or f"{CODE}/{name}" in code):
                raise ValueError(
                    f"{name}, on which the results depend, is not in the pack"
                )
        return Packed(
            described, own_files, [str(folder / CODE)] if code else [], jobs, progress
        )
    except (*MALFORMED, InputError) as error:
        raise InputError(
            path, f"{described.folder} is damaged: {describe_error(error)}", PACK
        ) from None
