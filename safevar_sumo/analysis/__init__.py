"""Questions asked of a study or of its results: a package or a file for each question."""
