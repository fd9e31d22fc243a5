"""A small robot to try worlds with, as data: what every simulator's writer makes it of.

A differential drive of the size and mass of outdoor research platforms (Clearpath's Jackal weighs 17 kg, its Husky 50):
two driven wheels, a caster that slides, a mast with a camera, a lidar on top. Its frame (`base_link`, REP 105) lies on
the ground, midway between the driven wheels: x ahead, y to the left, z up; metres, kilograms, radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, radians, tan

Vector = tuple[float, float, float]
RUBBER, SLIDING = 0.9, 0.01
"""Coulomb friction of tyres, and of the caster, which is a ball in a bearing."""


@dataclass(frozen=True)
class Box:
    """size: (x, y, z)."""

    size: Vector


@dataclass(frozen=True)
class Cylinder:
    """axis: along "y", as wheels are, or "z"."""

    radius: float
    length: float
    axis: str


@dataclass(frozen=True)
class Sphere:
    """Around its middle."""

    radius: float


@dataclass(frozen=True)
class Link:
    """A rigid part of one shape, around whose middle its frame lies; the first link's frame is the robot's.

    Attributes:
        name: as in ROS.
        shape: of what is seen, of what collides, and of its mass.
        place: of its middle in the robot's frame.
        mass: spread evenly.
        colour: RGB from 0 to 1.
        friction: of its surface.
        driven: whether a motor turns it about its axis, forwards where it turns positively; else it is fixed.
    """

    name: str
    shape: Box | Cylinder | Sphere
    place: Vector
    mass: float
    colour: Vector
    friction: float = RUBBER
    driven: bool = False

    @property
    def inertia(self) -> Vector:
        """Moments about its axes, kg m²."""
        shape, mass = self.shape, self.mass
        if isinstance(shape, Box):
            x, y, z = (side**2 for side in shape.size)
            return mass * (y + z) / 12, mass * (x + z) / 12, mass * (x + y) / 12
        if isinstance(shape, Sphere):
            return (0.4 * mass * shape.radius**2,) * 3
        along, across = mass * shape.radius**2 / 2, mass * (3 * shape.radius**2 + shape.length**2) / 12
        return (across, along, across) if shape.axis == "y" else (across, across, along)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks ahead.

    Attributes:
        link: which it is part of; ahead: metres from that one's middle to its own.
        width, height: pixels.
        across: horizontal field of view, radians.
        nearest, farthest: metres.
        rate: pictures a second.
    """

    link: str
    ahead: float
    width: int
    height: int
    across: float
    nearest: float
    farthest: float
    rate: float

    @property
    def upright(self) -> float:
        """Vertical field of view, radians."""
        return 2 * atan(tan(self.across / 2) * self.height / self.width)


@dataclass(frozen=True)
class Lidar:
    """A lidar that turns about the upright axis through the middle of its link.

    Attributes:
        link: which it is.
        around: rays a turn.
        rings: of them, from `lowest` to `highest`, radians.
        nearest, farthest, noise: metres.
        rate: turns a second.
    """

    link: str
    around: int
    rings: int
    lowest: float
    highest: float
    nearest: float
    farthest: float
    noise: float
    rate: float


@dataclass(frozen=True)
class Robot:
    """A robot with two driven wheels.

    Attributes:
        name: of its model.
        links: the body first, to which all others are joined.
        camera, lidar: its sensors; an IMU lies in the robot's frame.
        imu_rate: readings a second.
        speed, acceleration: at most, m/s and m/s².
        torque: of a motor at most, Nm.
    """

    name: str
    links: tuple[Link, ...]
    camera: Camera
    lidar: Lidar
    imu_rate: float
    speed: float
    acceleration: float
    torque: float

    def link(self, name: str) -> Link:
        """By its name."""
        return next(link for link in self.links if link.name == name)

    @property
    def base(self) -> Link:
        """The body."""
        return self.links[0]

    @property
    def joined(self) -> tuple[Link, ...]:
        """All but the body."""
        return self.links[1:]

    def within(self, link: Link) -> Vector:
        """The middle of a link's shape in its own frame."""
        return link.place if link is self.base else (0.0, 0.0, 0.0)

    @property
    def wheels(self) -> tuple[Link, Link]:
        """Left and right."""
        left, right = sorted((link for link in self.links if link.driven), key=lambda link: -link.place[1])
        return left, right

    @property
    def wheel_radius(self) -> float:
        """Of the driven ones."""
        shape = self.wheels[0].shape
        assert isinstance(shape, Cylinder)
        return shape.radius

    @property
    def track(self) -> float:
        """Metres between the driven wheels' middles."""
        left, right = self.wheels
        return left.place[1] - right.place[1]

    def turning(self, speed: float, turn: float) -> tuple[float, float]:
        """Radians a second of the left and the right wheel for a speed (m/s) and a turn to the left (rad/s)."""
        aside = turn * self.track / 2
        return (speed - aside) / self.wheel_radius, (speed + aside) / self.wheel_radius


@dataclass(frozen=True)
class Start:
    """Where a robot starts.

    Attributes:
        position: of its frame, world metres.
        angles: roll, pitch and yaw (fixed axes x, y, z), radians.
        by: what is known of the way that it faces along: "lane", "road" or "path".
    """

    position: Vector
    angles: Vector
    by: str


GREY, BLACK, YELLOW = (0.35, 0.35, 0.37), (0.08, 0.08, 0.08), (0.95, 0.75, 0.1)
ROBOT = Robot(
    name="robot",
    links=(
        Link("base_link", Box((0.62, 0.40, 0.18)), (-0.14, 0.0, 0.25), 20.0, YELLOW),
        Link("left_wheel", Cylinder(0.165, 0.06, "y"), (0.0, 0.26, 0.165), 1.5, BLACK, driven=True),
        Link("right_wheel", Cylinder(0.165, 0.06, "y"), (0.0, -0.26, 0.165), 1.5, BLACK, driven=True),
        Link("caster", Sphere(0.08), (-0.36, 0.0, 0.08), 0.6, GREY, friction=SLIDING),
        Link("mast", Cylinder(0.02, 0.30, "z"), (0.05, 0.0, 0.49), 0.5, GREY),
        Link("camera_link", Box((0.04, 0.12, 0.04)), (0.09, 0.0, 0.58), 0.2, BLACK),
        Link("lidar_link", Cylinder(0.05, 0.08, "z"), (0.05, 0.0, 0.68), 0.8, BLACK),
    ),
    camera=Camera("camera_link", 0.021, 640, 480, radians(80.0), 0.05, 200.0, 15.0),
    lidar=Lidar("lidar_link", 900, 16, radians(-15.0), radians(15.0), 0.3, 100.0, 0.01, 10.0),
    imu_rate=100.0,
    speed=2.0,
    acceleration=2.0,
    torque=10.0,
)
"""The robot that `scan2sim export --robot` puts into worlds."""
