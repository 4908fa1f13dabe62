"""Other people's code: looked up by name, held to a contract, called through one guard."""

from safevar_sumo.plugins.contract import Contract, takes
from safevar_sumo.plugins.guard import Guard
from safevar_sumo.plugins.lending import lent
from safevar_sumo.plugins.lookup import Lookup, Member, forget_foreign, make_reachable
from safevar_sumo.plugins.making import check_parameters, made
from safevar_sumo.plugins.own_modules import OwnModules
from safevar_sumo.plugins.undisturbed import undisturbed

__all__ = ["Contract", "Guard", "Lookup", "Member", "OwnModules", "check_parameters", "forget_foreign", "lent", "made", "make_reachable",
           "takes", "undisturbed"]
