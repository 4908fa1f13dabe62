"""Show a changed vehicle beside the original: as figure, as animation and in sumo-gui."""
