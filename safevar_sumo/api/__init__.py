"""The public library, which `import safevar_sumo` re-exports, without the questions of
`safevar_sumo.questions`.
"""

from safevar_sumo.api.evaluation import evaluate as evaluate
from safevar_sumo.api.running import run as run
from safevar_sumo.api.simulation import Simulation as Simulation, simulate as simulate
from safevar_sumo.questions.case import Results as Results
from safevar_sumo.questions.subject import load as load
