"""`python -m safevar_sumo`, and the command `safevar-sumo`."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the program. It is loaded here and not above, because every worker process loads this module too."""
    try:
        from safevar_sumo import cli
    except KeyboardInterrupt:
        print("safevar-sumo: interrupted", file=sys.stderr)
        sys.exit(130)
    cli.main()


if __name__ == "__main__":
    main()
