"""Other people's code: looked up by name, held to a contract, called through one guard."""

from safevar_sumo.plugins.contract import Contract, takes
from safevar_sumo.plugins.digests import DIGITS, Files, changes, digest_of, digests, located, named_files
from safevar_sumo.plugins.guard import Guard
from safevar_sumo.plugins.lending import lent
from safevar_sumo.plugins.lookup import Lookup, Member, forget_foreign, inherit_reachable, make_reachable, reachable
from safevar_sumo.plugins.making import check_parameters, made
from safevar_sumo.plugins.own_modules import OwnModules
from safevar_sumo.plugins.reading import noted_reading
from safevar_sumo.plugins.undisturbed import undisturbed

__all__ = ["DIGITS", "Contract", "Files", "Guard", "Lookup", "Member", "OwnModules", "changes", "check_parameters", "digest_of", "digests",
           "forget_foreign", "inherit_reachable", "lent", "located", "made", "make_reachable", "named_files", "noted_reading",
           "reachable", "takes", "undisturbed"]
