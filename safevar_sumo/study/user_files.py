"""The user code, the FMUs and the data files that a study names."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from safevar_sumo.errors import InputError
from safevar_sumo.study.encounters import MatrixTest
from safevar_sumo.study.schema import PYMOO, Study


def user_code_names(study: Study) -> list[str]:
    """The keys of a study with user code and their values, such as `ads.model =
    'my_ads:Careful'`.
    """
    return [f"{key} = {name!r}" for key, name in (*user_code(study), *fmus_of(study))]


def without_skipping(study: Study) -> Study:
    """The study, but the first failure of its simulator stops it."""
    return msgspec.structs.replace(
        study, search=msgspec.structs.replace(study.search, failed="stop")
    )


def fmus_of(study: Study) -> list[tuple[str, str]]:
    """The key and the path of a study's FMU, as a list; an empty list without an FMU."""
    if study.ads.kind == "fmu":
        return [("ads.model", study.ads.model)]
    return []


def user_modules(study: Study) -> list[str]:
    """The names of the modules with a study's user code."""
    return sorted({name.partition(":")[0] for _, name in user_code(study)})


def user_code(study: Study) -> list[tuple[str, str]]:
    """The keys and the names of a study's user code."""
    tests = [test.model for test in study.tests]
    names_by_key = {
        "vehicle.model": [study.vehicle.model],
        "ads.model": [study.ads.model],
        "scenario.model": [study.scenario.model, *tests],
        "metrics.also": study.metrics.also,
        "search.objectives": study.search.objectives,
        "search.algorithms": study.search.algorithms,
    }
    fmus = fmus_of(study)
    pairs = []
    for key, names in names_by_key.items():
        for name in dict.fromkeys(names):
            is_code = ":" in name and not name.startswith(PYMOO)
            if is_code and (key, name) not in fmus:
                pairs.append((key, name))
    return pairs


def data_files(study: Study) -> dict[str, str]:
    """The paths of the data files and folders that a study names. A study names files under
    `files`, or as the parameter `file` of a shipped scenario.

    Raises
    ------
    InputError
        If a file does not exist.
    """
    places = study.origin.places or (os.getcwd(),)
    paths = {}
    for key, names in (
        ("vehicle.files", study.vehicle.files),
        ("ads.files", study.ads.files),
        ("scenario.files", study.scenario.files),
        ("scenario.parameters.file", _scenario_files(study)),
    ):
        for name in names:
            candidates = (Path(place, name) for place in places)
            path = next(
                (candidate for candidate in candidates if candidate.exists()), None
            )
            if path is None:
                raise InputError(
                    study.source,
                    f"{key}: there is no file {name!r}",
                    f"the path of a file or folder, relative to {places[0]}",
                )
            paths[name] = os.path.abspath(path)
    return paths


def _scenario_files(study: Study) -> list[str]:
    """The values of the parameter `file` of shipped scenarios, in all tests of the study."""
    texts = []
    for test in study.tests or [MatrixTest(name="it")]:
        if ":" not in (test.model or study.scenario.model):
            axes = study.axes_of(test)
            if "file" in axes:
                texts += axes["file"].at
            for table in (study.scenario, test):
                texts.append(table.parameters.get("file"))
    return [text for text in texts if isinstance(text, str)]
