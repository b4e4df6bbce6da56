"""A clock for the stages of a command."""

import time


class Clock:
    """Seconds spent in each named stage; a stage that comes back goes on counting."""

    def __init__(self, stage):
        self.seconds, self.stage, self.name = {}, stage, None

    def next(self, name):
        """End the present stage and begin the named one."""
        self.stop()
        self.name, self.begun = name, time.perf_counter()
        self.stage(name)

    def move(self, stage, other, seconds):
        """Count a part of a stage, which ends, as another one."""
        self.stop()
        self.seconds[stage] -= seconds
        self.seconds[other] = self.seconds.get(other, 0.0) + seconds

    def stop(self):
        """End the present stage; returns {stage: seconds}."""
        if self.name:
            self.seconds[self.name] = self.seconds.get(self.name, 0.0) + time.perf_counter() - self.begun
        self.name = None
        return self.seconds
