"""The third-party simulators that an adapter exists for, and what each is of."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Simulator:
    """A third-party simulator that an adapter exists for."""

    module: str  # in `adapt.simulators`; its `make(system)` gives the plant
    package: str  # what it imports
    system: str
    vehicle: str | None = None  # that a policy ships for


SIMULATORS = {
    "rotorpy": Simulator("rotorpy_quadrotor", "rotorpy", "quadrotor"),
    "drone-models": Simulator("drone_models_crazyflie", "drone_models", "quadrotor", "crazyflie"),
    "jsbsim": Simulator("jsbsim_aircraft", "jsbsim", "fixed_wing", "j3cub"),
    "mujoco": Simulator("mujoco_cartpole", "mujoco", "cartpole"),
}
