"""A robot of one joint with LeRobot's cameras, and a teleoperator that moves it: no hardware."""

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINT = "joint.pos"


@RobotConfig.register_subclass("fake_robot")
@dataclass
class FakeRobotConfig(RobotConfig):
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class Connected:
    """What robot and teleoperator have in common: nothing to calibrate or configure."""

    is_connected, is_calibrated = False, True

    def calibrate(self):
        pass

    def configure(self):
        pass


class FakeRobot(Connected, Robot):
    config_class, name = FakeRobotConfig, "fake_robot"

    def __init__(self, config):
        super().__init__(config)
        self.cameras, self.position = make_cameras_from_configs(config.cameras), 0.0

    @property
    def observation_features(self):
        return {JOINT: float} | {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}

    @property
    def action_features(self):
        return {JOINT: float}

    def connect(self, calibrate=True):
        for camera in self.cameras.values():
            camera.connect()
        self.is_connected = True

    def get_observation(self):
        return {JOINT: self.position} | {name: camera.read_latest() for name, camera in self.cameras.items()}

    def send_action(self, action):
        self.position = action[JOINT]
        return action

    def disconnect(self):
        for camera in self.cameras.values():
            camera.disconnect()
        self.is_connected = False


@TeleoperatorConfig.register_subclass("fake_teleop")
@dataclass
class FakeTeleopConfig(TeleoperatorConfig):
    pass


class FakeTeleop(Connected, Teleoperator):
    config_class, name = FakeTeleopConfig, "fake_teleop"
    action_features, feedback_features, target = {JOINT: float}, {}, 0.0

    def connect(self, calibrate=True):
        self.is_connected = True

    def get_action(self):
        self.target += 0.5
        return {JOINT: self.target}

    def send_feedback(self, feedback):
        pass

    def disconnect(self):
        self.is_connected = False
