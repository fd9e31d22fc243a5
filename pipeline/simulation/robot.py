"""A small robot for testing worlds, as data from which writers for every simulator generate their model.

A differential drive with the size and mass of outdoor research platforms (Clearpath's Jackal weighs 17 kg, its Husky
50 kg): two driven wheels, a sliding caster, a mast with a camera, a lidar on top. Its frame (`base_link`, REP 105) is
on the ground, midway between the driven wheels: x forward, y left, z up; metres, kilograms, radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, radians, tan

Vector = tuple[float, float, float]
TYRE_FRICTION, CASTER_FRICTION = 0.9, 0.01
"""Coulomb friction coefficients of the tyres, and of the caster, which is a ball in a bearing."""


@dataclass(frozen=True)
class Box:
    """A box of `size` (x, y, z)."""

    size: Vector

    @property
    def half(self) -> Vector:
        """Half the sides of the box around it."""
        return self.size[0] / 2, self.size[1] / 2, self.size[2] / 2


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along `axis` "y" (wheels) or "z"."""

    radius: float
    length: float
    axis: str

    @property
    def half(self) -> Vector:
        """Half the sides of the box around it."""
        along, across = self.length / 2, self.radius
        return (across, along, across) if self.axis == "y" else (across, across, along)


@dataclass(frozen=True)
class Sphere:
    """A sphere around the link's origin."""

    radius: float

    @property
    def half(self) -> Vector:
        """Half the sides of the box around it."""
        return self.radius, self.radius, self.radius


@dataclass(frozen=True)
class Link:
    """A rigid link with one shape. Its frame is at the shape's centre; the first link's frame is that of the robot.

    Attributes:
        name: link name, as in ROS.
        shape: shape for rendering, collision and inertia.
        place: position of its centre in the robot's frame.
        mass: mass, uniformly distributed.
        colour: RGB from 0 to 1.
        friction: friction coefficient of its surface.
        driven: whether a motor rotates it about its axis (positive is forward); otherwise it is fixed.
    """

    name: str
    shape: Box | Cylinder | Sphere
    place: Vector
    mass: float
    colour: Vector
    friction: float = TYRE_FRICTION
    driven: bool = False

    @property
    def inertia(self) -> Vector:
        """Principal moments of inertia, kg m²."""
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
    """A forward-looking pinhole camera.

    Attributes:
        link: name of its link; ahead: distance of the camera in front of the link's centre, metres.
        width, height: pixels.
        horizontal_fov: radians.
        min_range, max_range: clipping distances, metres.
        rate: frame rate, Hz.
    """

    link: str
    ahead: float
    width: int
    height: int
    horizontal_fov: float
    min_range: float
    max_range: float
    rate: float

    @property
    def vertical_fov(self) -> float:
        """Vertical field of view, radians."""
        return 2 * atan(tan(self.horizontal_fov / 2) * self.height / self.width)


@dataclass(frozen=True)
class Lidar:
    """A lidar that rotates about the vertical axis through the centre of its link.

    Attributes:
        link: name of its link.
        rays_per_turn: horizontal samples.
        rings: number of scan lines, from `min_elevation` to `max_elevation`, radians.
        min_range, max_range, noise: metres.
        rate: turns per second.
    """

    link: str
    rays_per_turn: int
    rings: int
    min_elevation: float
    max_elevation: float
    min_range: float
    max_range: float
    noise: float
    rate: float


@dataclass(frozen=True)
class Robot:
    """A differential drive robot.

    Attributes:
        name: name of its model.
        links: links; all others are attached to the first, the body.
        camera, lidar: sensors; an IMU is at the origin of the robot's frame.
        imu_rate: Hz.
        speed, acceleration: maximum, m/s and m/s².
        torque: maximum of a motor, Nm.
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
        """The link with that name."""
        return next(link for link in self.links if link.name == name)

    @property
    def base(self) -> Link:
        """The body."""
        return self.links[0]

    @property
    def attached(self) -> tuple[Link, ...]:
        """All links except the body."""
        return self.links[1:]

    def centre_in_link(self, link: Link) -> Vector:
        """Centre of a link's shape in the link's own frame."""
        return link.place if link is self.base else (0.0, 0.0, 0.0)

    @property
    def extent(self) -> tuple[Vector, Vector]:
        """Lowest and highest corner of the box around the robot, in its frame."""

        def end(k: int, sign: int) -> float:
            return sign * max(sign * link.place[k] + link.shape.half[k] for link in self.links)

        return (end(0, -1), end(1, -1), end(2, -1)), (end(0, 1), end(1, 1), end(2, 1))

    @property
    def wheels(self) -> tuple[Link, Link]:
        """Left and right driven wheel."""
        left, right = sorted((link for link in self.links if link.driven), key=lambda link: -link.place[1])
        return left, right

    @property
    def wheel_radius(self) -> float:
        """Radius of the driven wheels, metres."""
        shape = self.wheels[0].shape
        assert isinstance(shape, Cylinder)
        return shape.radius

    @property
    def track(self) -> float:
        """Distance between the centres of the driven wheels, metres."""
        left, right = self.wheels
        return left.place[1] - right.place[1]

    def wheel_speeds(self, speed: float, yaw_rate: float) -> tuple[float, float]:
        """Angular velocities (rad/s) of the left and right wheel for a speed (m/s) and a yaw rate (rad/s)."""
        difference = yaw_rate * self.track / 2
        return (speed - difference) / self.wheel_radius, (speed + difference) / self.wheel_radius


@dataclass(frozen=True)
class Start:
    """Spawn pose of a robot.

    Attributes:
        position: position of its frame, world metres.
        angles: roll, pitch and yaw (fixed axes x, y, z), radians.
        by: what its heading follows: "lane", "road" or "path"; "floor", "ground": it is in free space.
    """

    position: Vector
    angles: Vector
    by: str


GREY, BLACK, YELLOW = (0.35, 0.35, 0.37), (0.08, 0.08, 0.08), (0.95, 0.75, 0.1)
OPTICAL_FRAME = "camera_optical_frame"
"""Frame of the camera's images in ROS: x right, y down, z ahead (REP 103)."""
ROBOT = Robot(
    name="robot",
    links=(
        Link("base_link", Box((0.62, 0.40, 0.18)), (-0.14, 0.0, 0.25), 20.0, YELLOW),
        Link("left_wheel", Cylinder(0.165, 0.06, "y"), (0.0, 0.26, 0.165), 1.5, BLACK, driven=True),
        Link("right_wheel", Cylinder(0.165, 0.06, "y"), (0.0, -0.26, 0.165), 1.5, BLACK, driven=True),
        Link("caster", Sphere(0.08), (-0.36, 0.0, 0.08), 0.6, GREY, friction=CASTER_FRICTION),
        Link("mast", Cylinder(0.02, 0.30, "z"), (0.05, 0.0, 0.49), 0.5, GREY),
        Link("camera_link", Box((0.04, 0.12, 0.04)), (0.09, 0.0, 0.58), 0.2, BLACK),
        Link("lidar_link", Cylinder(0.05, 0.08, "z"), (0.05, 0.0, 0.68), 0.8, BLACK),
    ),
    camera=Camera("camera_link", 0.021, 640, 480, radians(80.0), 0.05, 1000.0, 15.0),
    lidar=Lidar("lidar_link", 900, 16, radians(-15.0), radians(15.0), 0.3, 100.0, 0.01, 10.0),
    imu_rate=100.0,
    speed=2.0,
    acceleration=2.0,
    torque=10.0,
)
"""The robot that `scan2sim export --robot` puts into worlds."""
