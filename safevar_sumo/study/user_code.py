"""The user code and FMUs that a study names."""

from __future__ import annotations

from safevar_sumo.study.schema import Study


def user_code_names(study: Study) -> list[str]:
    """The keys of a study that name user code, such as `ads.model = 'my_ads:Careful'`."""
    return [f"{key} = {name!r}" for key, name in (*_keys_of_user_code(study), *fmus_of(study))]


def fmus_of(study: Study) -> list[tuple[str, str]]:
    """Keys and paths of a study's FMUs."""
    return [
        (f"{key}.model", table.model)
        for key, table in (("vehicle", study.vehicle), ("ads", study.ads))
        if table.kind == "fmu"
    ]


def user_code_packages(study: Study) -> list[str]:
    """The top-level packages of a study's user code."""
    return sorted({name.partition(":")[0].partition(".")[0] for _, name in _keys_of_user_code(study)})


def _keys_of_user_code(study: Study) -> list[tuple[str, str]]:
    """Keys and names of a study's user code."""
    tests = [] if study.matrix is None else [test.model for test in study.matrix.tests]
    names_by_key = {
        "vehicle.model": [study.vehicle.model],
        "ads.model": [study.ads.model],
        "scenario.model": [study.scenario.model, *tests],
        "metrics.also": study.metrics.also,
        "search.objectives": study.search.objectives,
    }
    functions = [constraint.function for constraint in study.constraints]
    names_by_key["constraints.function"] = [name for name in functions if name]
    fmus = fmus_of(study)
    return [
        (key, name)
        for key, names in names_by_key.items()
        for name in dict.fromkeys(names)
        if ":" in name and (key, name) not in fmus
    ]
