"""A script with a loop of its own, which runs when it is imported."""

import traci
from controllers import start_sumo

start_sumo(traci, "vut")
