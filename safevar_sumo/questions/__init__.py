"""Questions about a study or its results; each question has its own package or file."""
