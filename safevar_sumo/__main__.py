"""`python -m safevar_sumo`, and the command `safevar-sumo`."""

from __future__ import annotations

import os
import sys
import threading
import time

ENDING_TIME = 5.0
"""Time that threads and exit functions of user code have when a command has ended [s]."""


def main() -> None:
    """Run the program; it is imported here and not above, because every worker process loads this
    module too.
    """
    _put_installed_modules_first()
    from safevar_sumo import cli

    try:
        cli.run_command_line()
    except SystemExit as end:
        threading.Thread(target=_end_at_last, args=(end.code,), daemon=True).start()
        raise


def _end_at_last(code: object) -> None:
    """End this process, and simulators, if threads or exit functions keep it from ending."""
    time.sleep(ENDING_TIME)
    if simulators := sys.modules.get("safevar_sumo.sumo.kept"):
        simulators.close_simulator()
    os._exit(code if isinstance(code, int) else 1)


def _put_installed_modules_first() -> None:
    """Move the working directory, which `python -m` puts first, to the end of the path: a
    `numpy.py` there must not replace numpy.
    """
    if sys.path[0] in ("", os.getcwd()):
        sys.path.append(sys.path.pop(0))
    os.environ.setdefault("PYTHONSAFEPATH", "1")


if __name__ == "__main__":
    main()
