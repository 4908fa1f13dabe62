from safevar_sumo.ads import ScalarAds


class Careful(ScalarAds):
    def __init__(self, margin):
        self.margin = margin

    def drive(self, seen):
        stopping = seen.speed**2 / (2 * 0.8 * self.nominal.decel)
        if seen.gap < stopping + self.margin:
            return 0.0, 1.0
        return (0.8, 0.0) if seen.speed < 8 else (0.0, 0.0)
