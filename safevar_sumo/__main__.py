"""`python -m safevar_sumo`, and the command `safevar-sumo`."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the program; it is imported here and not above, because every worker process loads this
    module too.
    """
    _put_installed_modules_first()
    from safevar_sumo import cli

    cli.run_command_line()


def _put_installed_modules_first() -> None:
    """Move the working directory, which `python -m` puts first, to the end of the path: a
    `numpy.py` there must not replace numpy.
    """
    if sys.path[0] in ("", os.getcwd()):
        sys.path.append(sys.path.pop(0))
    os.environ.setdefault("PYTHONSAFEPATH", "1")


if __name__ == "__main__":
    main()
