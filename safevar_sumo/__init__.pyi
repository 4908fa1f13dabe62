from .analysis.answer import Answer as Answer
from .analysis.ask import question as question
from .analysis.compare import compare as compare
from .analysis.explain import explain as explain
from .analysis.explain.answer import Explained as Explained
from .analysis.explain.causes import Cause as Cause
from .analysis.explain.failure import Explanation as Explanation
from .analysis.opinion import opinion as opinion
from .analysis.rating import rating as rating
from .analysis.repair import repair as repair
from .analysis.risk import risk as risk
from .analysis.rules import rules as rules
from .analysis.subject import Results as Results, load as load
from .analysis.tolerance import tolerance as tolerance
from .analysis.tolerance.answer import Tolerance as Tolerance
from .api import Figures as Figures, Tables as Tables, figures as figures, tables as tables
from .api.evaluation import evaluate as evaluate
from .api.running import run as run
from .api.simulation import Simulation as Simulation, load_study as load_study, simulate as simulate
from .campaign.pool import Pool as Pool
from .errors import InputError as InputError, SafevarError as SafevarError, SimulationError as SimulationError
from .metrics import Criterion as Criterion, Unsafe as Unsafe
from .records import Outcome as Outcome
from .reference.agreement import validate as validate
from .reference.rows import import_published as import_published
from .replay.animation import animate as animate
from .replay.comparison import Comparison as Comparison, compare_with_original as compare_with_original
from .replay.figure import draw_comparison as draw_comparison
from .replay.gui import show_in_gui as show_in_gui
from .report import report as report
from .study import Study as Study, StudyLike as StudyLike, Weather as Weather, study_names as study_names
from .terminal import Progress as Progress

__version__: str
