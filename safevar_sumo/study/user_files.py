"""The user code, FMUs and data files that a study names."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from safevar_sumo.errors import InputError
from safevar_sumo.study.encounters import MatrixTest
from safevar_sumo.study.schema import PYMOO, Study


def user_code_names(study: Study) -> list[str]:
    """The keys of a study that name user code, such as `ads.model = 'my_ads:Careful'`."""
    return [f"{key} = {name!r}" for key, name in (*user_code(study), *fmus_of(study))]


def without_skipping(study: Study) -> Study:
    """A study that stops where its simulator fails."""
    search = msgspec.structs.replace(study.search, failed="stop")
    return msgspec.structs.replace(study, search=search)


def fmus_of(study: Study) -> list[tuple[str, str]]:
    """Key and path of a study's FMU."""
    return [("ads.model", study.ads.model)] if study.ads.kind == "fmu" else []


def user_modules(study: Study) -> list[str]:
    """The modules of a study's user code."""
    return sorted({name.partition(":")[0] for _, name in user_code(study)})


def user_code(study: Study) -> list[tuple[str, str]]:
    """Keys and names of a study's user code."""
    tests = [test.model for test in study.tests]
    names_by_key = {
        "vehicle.model": [study.vehicle.model],
        "ads.model": [study.ads.model],
        "scenario.model": [study.scenario.model, *tests],
        "metrics.also": study.metrics.also,
        "search.objectives": study.search.objectives,
        "search.algorithms": [
            name for name in study.search.algorithms if not name.startswith(PYMOO)
        ],
    }
    fmus = fmus_of(study)
    return [
        (key, name)
        for key, names in names_by_key.items()
        for name in dict.fromkeys(names)
        if ":" in name and (key, name) not in fmus
    ]


def data_files(study: Study) -> dict[str, str]:
    """The paths of the data files and folders that a study names, by their names: in `files`, or as
    the parameter `file` of a shipped scenario.

    Raises
    ------
    InputError
        If one of them does not exist.
    """
    places = study.origin.places or (os.getcwd(),)
    paths = {}

    # Each file or folder beside the study.
    named = [
        ("vehicle.files", study.vehicle.files),
        ("ads.files", study.ads.files),
        ("scenario.files", study.scenario.files),
        ("scenario.parameters.file", _scenario_files(study)),
    ]
    for key, name in ((key, name) for key, names in named for name in names):
        found = [os.path.abspath(path) for place in places if (path := Path(place, name)).exists()]
        if not found:
            problem = f"{key}: there is no file {name!r}"
            raise InputError(
                study.source, problem, f"the path of a file or folder, relative to {places[0]}"
            )
        paths[name] = found[0]
    return paths


def _scenario_files(study: Study) -> list[str]:
    """The values of the parameter `file` of shipped scenarios, in all tests."""
    texts = list[Any]()
    for test in study.tests or [MatrixTest(name="it")]:
        if ":" not in (test.model or study.scenario.model):
            axes = study.axes_of(test)
            texts += axes["file"].at if "file" in axes else []
            texts += [study.scenario.parameters.get("file"), test.parameters.get("file")]
    return [*dict.fromkeys(text for text in texts if isinstance(text, str))]
