"""A changed vehicle beside the original: as a figure, as an animation, and in sumo-gui."""
