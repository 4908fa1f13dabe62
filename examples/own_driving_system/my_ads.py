from safevar_sumo.ads import ScalarAds


class Careful(ScalarAds):
    """Brakes fully when the pedestrian is less than the stopping distance and 2 m away."""

    def drive(self, seen):
        stopping = seen.speed**2 / (2 * 0.6 * self.nominal.decel)
        if abs(seen.lateral) < 2.5 and seen.gap < stopping + 2.0:
            return 0.0, 1.0  # throttle, brake
        return (0.5, 0.0) if seen.speed < 5 else (0.0, 0.0)
