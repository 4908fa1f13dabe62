"""Published data: reading it, comparing a study with it, importing it as results."""
