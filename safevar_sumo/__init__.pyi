from .api.evaluation import evaluate as evaluate
from .api.running import run as run
from .api.simulation import (
    Simulation as Simulation,
    load_study as load_study,
    simulate as simulate,
)
from .campaign.pool import Pool as Pool
from .errors import (
    InputError as InputError,
    SafevarError as SafevarError,
    SimulationError as SimulationError,
)
from .metrics import CriterionLike as CriterionLike, Unsafe as Unsafe
from .questions.answer import Answer as Answer
from .questions.ask import question as question
from .questions.case import Results as Results
from .questions.compare import compare as compare
from .questions.explain import explain as explain
from .questions.permit import permit as permit
from .questions.repair import repair as repair
from .questions.research_questions.answer import figures as figures, tables as tables
from .questions.risk import risk as risk
from .questions.rules import rules as rules
from .questions.subject import load as load
from .questions.tolerance import tolerance as tolerance
from .records import Outcome as Outcome
from .reference.agreement import validate as validate
from .reference.rows import import_published as import_published
from .replay.animation import animate as animate
from .replay.comparison import Comparison as Comparison, comparison_of as comparison_of
from .replay.figure import draw_comparison as draw_comparison
from .replay.gui import show_in_gui as show_in_gui
from .report import report as report
from .study import (
    Study as Study,
    StudyLike as StudyLike,
    Weather as Weather,
    study_names as study_names,
)
from .terminal import Progress as Progress

__version__: str
