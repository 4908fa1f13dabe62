"""`python -m safevar_sumo`."""

from safevar_sumo.cli import main

if __name__ == "__main__":
    main()
