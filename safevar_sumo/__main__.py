"""Starts the program: `python -m safevar_sumo`, and the command `safevar-sumo`."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings

ENDING_TIME = 5.0
"""Time that threads and exit functions of user code get after the end of a command [s]."""


def main() -> None:
    """Run the program. The import is in this function, because every worker process loads this
    module, too, and does not need the program.
    """
    _put_installed_modules_first()
    _filter_warnings()
    from safevar_sumo import cli

    try:
        cli.run_command_line()
    except SystemExit as end:
        threading.Thread(target=_end_at_last, args=(end.code,), daemon=True).start()
        raise


def _end_at_last(code: object) -> None:
    """End this process and its simulators, if threads or exit functions of user code do not end."""
    time.sleep(ENDING_TIME)
    if simulators := sys.modules.get("safevar_sumo.sumo.kept"):
        simulators.close_simulator()
    os._exit(code if isinstance(code, int) else 1)


def _put_installed_modules_first() -> None:
    """Move the working directory from the beginning of Python's path to its end. `python -m` puts
    the working directory first, and a `numpy.py` there would replace numpy.
    """
    if sys.path[0] in ("", os.getcwd()):
        sys.path.append(sys.path.pop(0))
    os.environ.setdefault("PYTHONSAFEPATH", "1")


def _filter_warnings() -> None:
    """Filter warnings as Python does by default, whatever the environment states: the program
    prints its own warnings in any case, and no warning is an error.
    """
    os.environ.pop("PYTHONWARNINGS", None)
    sys.warnoptions.clear()
    warnings.resetwarnings()
    developer_warnings = (
        DeprecationWarning,
        PendingDeprecationWarning,
        ImportWarning,
        ResourceWarning,
    )
    for category in developer_warnings:
        warnings.simplefilter("ignore", category)


if __name__ == "__main__":
    main()
