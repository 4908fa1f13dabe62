"""`python -m safevar_sumo`, and the command `safevar-sumo`."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the program. It is loaded here and not above, because every worker process loads this module too."""
    _put_installed_modules_first()
    try:
        from safevar_sumo import cli
    except KeyboardInterrupt:
        print("safevar-sumo: interrupted", file=sys.stderr)
        sys.exit(130)
    cli.main()


def _put_installed_modules_first() -> None:
    """A `numpy.py` in the working directory, which `python -m` looks into first, is not numpy: here nor in a worker process."""
    if sys.path[0] in ("", os.getcwd()):
        sys.path.append(sys.path.pop(0))
    os.environ.setdefault("PYTHONSAFEPATH", "1")


if __name__ == "__main__":
    main()
