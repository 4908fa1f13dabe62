"""`python -m safevar_sumo`, and the command `safevar-sumo`."""

from __future__ import annotations

import faulthandler
import os
import sys
from contextlib import suppress


def main() -> None:
    """Run the program; it is imported here and not above, because every worker process loads this module too."""
    if sys.version_info < (3, 11):  # noqa: UP036
        _exit_with_error(f"needs Python 3.11 or newer; this is {'.'.join(map(str, sys.version_info[:3]))}", 1)
    _put_installed_modules_first()
    with suppress(AttributeError, OSError, RuntimeError, ValueError):  # a console without a file, or none
        faulthandler.enable(all_threads=False)  # if compiled user code crashes, its line is printed
    try:
        from safevar_sumo import cli

        cli.main()
    except KeyboardInterrupt:
        from safevar_sumo.errors import INTERRUPT_EXIT_CODE

        _exit_with_error("interrupted", INTERRUPT_EXIT_CODE)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("safevar_sumo."):
            raise
        _exit_with_error(f"{error.name} is not installed; in the checkout: pip install . (or make study, which makes a .venv)", 1)


def _exit_with_error(message: str, code: int) -> None:
    from safevar_sumo.shipped import PROGRAM

    print(f"{PROGRAM}: {message}", file=sys.stderr)
    sys.exit(code)


def _put_installed_modules_first() -> None:
    """Move the working directory, which `python -m` puts first, to the end of the path: a `numpy.py` there must not replace numpy."""
    if sys.path[0] in ("", os.getcwd()):
        sys.path.append(sys.path.pop(0))
    os.environ.setdefault("PYTHONSAFEPATH", "1")


if __name__ == "__main__":
    main()
