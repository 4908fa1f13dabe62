"""How metrics are headed in tables."""

METRIC_HEADS = {"safety_degree": "SD", "tet": "TET, s", "tit": "TIT, s^2", "ave_dece": "aveDece, m/s^2"}
