class StandingTruck:
    """A car at 15 m/s begins to brake 35 m before a standing truck."""

    UNITS = {"mass": "kg", "brake_force": "N"}
    version = "1.0"

    def simulate(self, setting):
        deceleration = setting["brake_force"] / setting["mass"]
        left = 35 - 15**2 / (2 * deceleration)  # distance to the truck at standstill
        if left > 0:
            return {"outcome": "stopped", "safety_degree": left}
        return {"outcome": "collision", "safety_degree": -((-2 * deceleration * left) ** 0.5)}
