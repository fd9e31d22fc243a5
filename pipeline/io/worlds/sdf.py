"""SDF 1.9 writer: a Gazebo world, the static model of a tile, and a world of many tiles in levels.

Design decisions:

- The world lists its systems. A world without any gets Gazebo's default ones, which don't include
  the sensors; a world that lists any gets no default. So it lists those of all sensors that every release from
  Fortress on has: a user's robot may have any of them, and without its system a sensor is silent. The names are those
  of Garden and later; Fortress accepts them since 6.16 (gz-sim #2275).
- World axes are the CRS's grid axes, so that world coordinates plus the origin are CRS coordinates.
  Grid north is not true north: `heading_deg` compensates the meridian convergence at the world's
  origin. With 0 a NavSat sensor would be 3 m off at 100 m where the convergence is 2 degrees.
- The photos contain the light and shadows of their day: the ambient light is strong, the sun weak, and
  the tile's surfaces don't cast shadows; robots do.
- `<background>` is the mean colour of what the photos show where the world has nothing (step `sky_colour`), sRGB.
- No `<material>`: it would replace the mesh's own textures.
- Every visual has the LAS code of its class as label for Gazebo's segmentation cameras.
- `<laser_retro>` of a visual is what the sensor `gpu_lidar` returns as intensity, at every range and angle: 255 times
  the reflectance, the scale of 8-bit lidars (Gazebo accepts 0 to 2000). Without it intensities are 0.
- The backdrop is what only cameras see. Its visuals have the visibility flag `BACKDROP_FLAG`; lidars need the mask
  `WITHOUT_BACKDROP`, which the robot's has. Depth and RGB-D cameras ignore masks (`Ogre2DepthCamera.cc` of gz-rendering
  6 to 10): they need a world without it (`export.backdrop`).
- Gazebo loads a level when the performer's box intersects the level's box, and unloads it when the
  performer is `<buffer>` away from it (gz-sim #28: the buffer has no effect on loading). Therefore a
  level's box is larger than its tile; otherwise a robot would see a tile only when standing on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from types import MappingProxyType
from xml.sax.saxutils import escape

from scan2sim.pipeline.core.types import Colour, Frame
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.simulation.collision_shapes import Solid
from scan2sim.pipeline.simulation.robot import ROBOT, Start

LEVEL_HEADROOM_M = 500.0
"""Extent of a level above and below its tile, so that it is loaded for flying robots, too."""
BACKDROP_FLAG = 2
"""`<visibility_flags>` of the backdrop; sensors with a `<visibility_mask>` without this bit do not see it."""
WITHOUT_BACKDROP = 0xFFFFFFFF & ~BACKDROP_FLAG
"""`<visibility_mask>` of sensors that must not see the backdrop."""
LASER_RETRO_FULL = 255
"""`<laser_retro>` of reflectance 1."""
SYSTEMS = {
    "physics": "Physics",
    "user-commands": "UserCommands",
    "scene-broadcaster": "SceneBroadcaster",
    "contact": "Contact",
    "imu": "Imu",
    "navsat": "NavSat",
    "magnetometer": "Magnetometer",
    "altimeter": "Altimeter",
    "air-pressure": "AirPressure",
    "forcetorque": "ForceTorque",
}
"""Systems of a world besides that of rendered sensors: the middle of their library's name, and their class."""
LEVEL_BUFFER_M = 20.0
"""Distance from a tile at which a performer loads it."""
SPAWN_FRAME = "spawn_pose"
"""Frame on free ground where robots can be placed."""
PERFORMER_NAME = ROBOT.name
"""Name of the model for which levels are loaded."""
BACKGROUND_RGB = (179, 204, 230)
"""Background of worlds without photos of the sky, sRGB."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class PlacedModel:
    """A tile's model in a world.

    Attributes:
        name: name of the model.
        offset: metres from the world's origin to the model's.
        low, high: corners of the bounding box of its meshes, metres from the model's origin.
    """

    name: str
    offset: Vector
    low: Vector
    high: Vector


@dataclass(frozen=True)
class Georeference:
    """Position of a world's origin on WGS 84, and heading of its axes.

    Attributes:
        latitude, longitude: degrees.
        elevation: metres, in the height system of the CRS (no vertical transformation is applied).
        heading: degrees counter-clockwise from east to the world's x axis, as defined by SDF.
    """

    latitude: float
    longitude: float
    elevation: float
    heading: float

    @classmethod
    def of(cls, frame: Frame) -> Georeference | None:
        """The georeference of a frame's origin; None for a local frame."""
        position = crs.to_wgs84(frame)
        return None if position is None else cls(*position, -degrees(crs.convergence(frame)))

    def as_metadata(self) -> dict[str, float | str]:
        """The entry `wgs84` of metadata.json."""
        return {
            "latitude_deg": self.latitude,
            "longitude_deg": self.longitude,
            "height_m": self.elevation,
            "height_system": "as in the CRS",
            "heading_deg": self.heading,
        }


def write_world(
    path: Path,
    names: Sequence[str],
    georeference: Georeference | None,
    offset: Vector,
    start: Start | None = None,
    sky: Colour | None = None,
    actors: str = "",
    spawn: Start | None = None,
) -> None:
    """Write a world that includes `model://<name>` for each name.

    Args:
        path: the world's .sdf file.
        names: names of its models; the first is also that of the world.
        georeference: of the world's origin, or None.
        offset: metres from the world's origin to the models'.
        start: start pose of the robot, `model://robot`; None: without a robot.
        sky: colour of the background, sRGB 0 to 255; None: `BACKGROUND_RGB`.
        actors: further elements of the world.
        spawn: pose on free ground for the user's robots, the frame `SPAWN_FRAME`, or None.
    """
    included = "".join(_include(name, offset) for name in names)
    content = included + _spawn(spawn) + _robot(start) + actors
    path.write_text(_world(path, names[0], georeference, content, sky, _spawn_note(spawn)), encoding="utf-8")


def write_levels(
    path: Path,
    name: str,
    georeference: Georeference | None,
    tiles: Sequence[PlacedModel],
    buffer: float,
    performer: str,
    start: Start | None = None,
    sky: Colour | None = None,
    everywhere: Mapping[str, Vector] = MappingProxyType({}),
    actors: str = "",
    spawn: Start | None = None,
) -> None:
    """Write a world of many models, each in its own level, so that Gazebo can load only those near a robot.

    Without Gazebo's option `--levels` all models are loaded, with or without a robot.

    Args:
        path: the world's .sdf file.
        name: name of the world.
        georeference: of the world's origin, or None.
        tiles: models, found as `model://<name>`.
        buffer: distance (m) from a tile at which a performer loads it; it is unloaded at twice the distance.
        performer: name of the model for which levels are loaded. If it doesn't exist, Gazebo only prints a warning.
        start: start pose of the robot, `model://robot`; None: without a robot.
        sky: as in `write_world`.
        everywhere: models that are loaded wherever the performer is: metres from the world's origin, by name.
        actors: further elements of the world.
        spawn: as in `write_world`.
    """
    path.write_text(
        _world(
            path,
            name,
            georeference,
            "".join(_include(tile.name, tile.offset) for tile in tiles)
            + "".join(_include(*model) for model in everywhere.items())
            + _spawn(spawn)
            + _robot(start)
            + actors
            + _levels(tiles, buffer, performer),
            sky,
            f"""{_spawn_note(spawn)}
     All tiles are loaded then. With the option "levels" (two dashes before it, which XML forbids here) only those
     near a performer are: the model that <performer> names below, if it is in this file when Gazebo starts, and
     any model that is named to the service /world/{name}/level/set_performer later.""",
        ),
        encoding="utf-8",
    )


@dataclass(frozen=True)
class Visual:
    """A visual of a model.

    Attributes:
        label: LAS code of its class.
        reflectance: 0 to 1, relative reflectance for lidar; None: not known.
        is_backdrop: whether it is part of the backdrop: only sensors that don't mask it see it, and it has no label.
    """

    label: int
    reflectance: float | None = None
    is_backdrop: bool = False


def write_model(folder: Path, name: str, visuals: Mapping[str, Visual], solids: Sequence[Solid]) -> None:
    """Write `model.sdf` and `model.config` of a static model.

    Args:
        folder: folder of the model.
        name: name of the model; its meshes are found as `model://<name>/...`.
        visuals: by the path of each visual mesh, relative to `folder`.
        solids: collision shapes; meshes are found as `meshes/collision_<name>.obj`.
    """
    visual_elements = "".join(_visual(name, mesh, visual) for mesh, visual in visuals.items())
    collision_elements = "".join(_collision(name, solid) for solid in solids)
    (folder / "model.sdf").write_text(
        f"""<?xml version="1.0"?>
<sdf version="1.9">
  <model name="{name}">
    <static>true</static>
    <link name="link">
{visual_elements}{collision_elements}    </link>
  </model>
</sdf>
""",
        encoding="utf-8",
    )
    write_config(folder, name, "A street scanned by lidar and photos: textured surfaces, and what bodies collide with.")


def write_config(folder: Path, name: str, description: str) -> None:
    """Write `model.config`, by which Gazebo finds a model, beside its `model.sdf`."""
    (folder / "model.config").write_text(
        f"""<?xml version="1.0"?>
<model>
  <name>{name}</name>
  <version>1.0</version>
  <sdf version="1.9">model.sdf</sdf>
  <author>
    <name>scan2sim</name>
  </author>
  <description>{description}</description>
</model>
""",
        encoding="utf-8",
    )


def _world(
    path: Path, name: str, georeference: Georeference | None, content: str, sky: Colour | None, note: str = ""
) -> str:
    """SDF of a world: physics, systems, light and `content`; `note` is added to the leading comment."""
    return f"""<?xml version="1.0"?>
<!-- Run in this folder: {open_command(path.name)}
     (Fortress, from 6.16: {open_command(path.name, fortress=True)})
     Gazebo Classic (gazebo, gzserver) doesn't read it.{note} -->
<sdf version="1.9">
  <world name="{name}">
    <physics name="dart_1ms" type="dart">
      <max_step_size>0.001</max_step_size>
      <real_time_factor>1</real_time_factor>
    </physics>
    <gravity>0 0 -9.8</gravity>
{_systems()}    <plugin filename="gz-sim-sensors-system" name="gz::sim::systems::Sensors">
      <render_engine>ogre2</render_engine>
    </plugin>
{_spherical_coordinates(georeference)}    <scene>
      <ambient>0.7 0.7 0.7 1</ambient>
      <background>{unit_colour(sky or BACKGROUND_RGB)} 1</background>
      <grid>false</grid>
    </scene>
    <light name="sun" type="directional">
      <cast_shadows>true</cast_shadows>
      <pose>0 0 100 0 0 0</pose>
      <diffuse>0.4 0.4 0.4 1</diffuse>
      <specular>0.1 0.1 0.1 1</specular>
      <direction>-0.4 0.2 -0.9</direction>
    </light>
{content}  </world>
</sdf>
"""


def open_command(world: str, *, fortress: bool = False) -> str:
    """Command that opens a world in its folder and starts it; models of the user's own are found as before."""
    variable, program = ("IGN_GAZEBO_RESOURCE_PATH", "ign gazebo") if fortress else ("GZ_SIM_RESOURCE_PATH", "gz sim")
    return f"{variable}=$PWD/models:${variable} {program} -r {world}"


def _systems() -> str:
    return "".join(
        f'    <plugin filename="gz-sim-{library}-system" name="gz::sim::systems::{name}"/>\n'
        for library, name in SYSTEMS.items()
    )


def _include(name: str, offset: Vector, angles: Vector = (0.0, 0.0, 0.0)) -> str:
    return f"""    <include>
      <uri>model://{name}</uri>
      <pose>{numbers(offset)} {numbers(angles)}</pose>
    </include>
"""


def _spawn(spawn: Start | None) -> str:
    if spawn is None:
        return ""
    return f"""    <frame name="{SPAWN_FRAME}">
      <pose>{numbers(spawn.position)} {numbers(spawn.angles)}</pose>
    </frame>
"""


def spawn_command(spawn: Start) -> str:
    """Command that places a robot in the running world; `ROBOT.sdf` stands for the user's model."""
    (x, y, z), yaw = spawn.position, spawn.angles[2]
    return f"ros2 run ros_gz_sim create -file ROBOT.sdf -x {x:.2f} -y {y:.2f} -z {z:.2f} -Y {yaw:.3f}"


def _spawn_note(spawn: Start | None) -> str:
    return f"\n     To add a robot: {spawn_command(spawn)}" if spawn else ""


def _robot(start: Start | None) -> str:
    return _include(ROBOT.name, start.position, start.angles) if start else ""


def _levels(tiles: Sequence[PlacedModel], buffer: float, performer: str) -> str:
    """The plugin element that defines levels; Gazebo parses it by its name and loads no file."""
    return f"""    <plugin filename="dummy" name="gz::sim">
      <performer name="performer">
        <ref>{escape(performer)}</ref>
        <geometry><box><size>2 2 2</size></box></geometry>
      </performer>
{"".join(_level(tile, buffer) for tile in tiles)}    </plugin>
"""


def _level(tile: PlacedModel, buffer: float) -> str:
    margin = (buffer, buffer, LEVEL_HEADROOM_M)
    corners = list(zip(tile.offset, tile.low, tile.high, strict=True))
    x, y, z = (offset + (low + high) / 2 for offset, low, high in corners)
    dx, dy, dz = (high - low + 2 * r for (_, low, high), r in zip(corners, margin, strict=True))
    return f"""      <level name="{tile.name}_level">
        <pose>{numbers((x, y, z))} 0 0 0</pose>
        <geometry><box><size>{numbers((dx, dy, dz))}</size></box></geometry>
        <buffer>{buffer:g}</buffer>
        <ref>{tile.name}</ref>
      </level>
"""


def _visual(name: str, mesh: str, visual: Visual) -> str:
    if visual.is_backdrop:
        return f"""      <visual name="{Path(mesh).stem}">
        <cast_shadows>false</cast_shadows>
        <visibility_flags>{BACKDROP_FLAG}</visibility_flags>
        <geometry>
          <mesh><uri>model://{name}/{mesh}</uri></mesh>
        </geometry>
      </visual>
"""
    level = visual.reflectance
    retro = "" if level is None else f"        <laser_retro>{LASER_RETRO_FULL * level:.0f}</laser_retro>\n"
    return f"""      <visual name="{Path(mesh).stem}">
        <cast_shadows>false</cast_shadows>
{retro}        <geometry>
          <mesh><uri>model://{name}/{mesh}</uri></mesh>
        </geometry>
        <plugin filename="gz-sim-label-system" name="gz::sim::systems::Label">
          <label>{visual.label}</label>
        </plugin>
      </visual>
"""


def _collision(name: str, solid: Solid) -> str:
    shape = solid.shape
    if isinstance(shape, Cylinder):
        pose = f"        <pose>{numbers(shape.centre)} {numbers(shape.angles)}</pose>\n"
        geometry = f"<cylinder><radius>{shape.radius:.4f}</radius><length>{shape.length:.4f}</length></cylinder>"
    else:
        pose, geometry = "", f"<mesh><uri>model://{name}/meshes/collision_{solid.name}.obj</uri></mesh>"
    mu = f"{solid.friction:g}"
    return f"""      <collision name="collision_{solid.name}">
{pose}        <geometry>
          {geometry}
        </geometry>
        <surface>
          <friction>
            <ode><mu>{mu}</mu><mu2>{mu}</mu2></ode>
            <bullet><friction>{mu}</friction><friction2>{mu}</friction2></bullet>
          </friction>
        </surface>
      </collision>
"""


def _spherical_coordinates(georeference: Georeference | None) -> str:
    if georeference is None:
        return ""
    return f"""    <spherical_coordinates>
      <surface_model>EARTH_WGS84</surface_model>
      <world_frame_orientation>ENU</world_frame_orientation>
      <latitude_deg>{georeference.latitude:.9f}</latitude_deg>
      <longitude_deg>{georeference.longitude:.9f}</longitude_deg>
      <elevation>{georeference.elevation:.4f}</elevation>
      <heading_deg>{georeference.heading:.7f}</heading_deg>
    </spherical_coordinates>
"""


def unit_colour(colour: Colour) -> str:
    """Levels from 0 to 1, separated by spaces."""
    return " ".join(f"{level / 255:.3g}" for level in colour)


def numbers(values: Iterable[float]) -> str:
    """Numbers separated by spaces, as in XML attributes, with 6 decimals (micrometres)."""
    return " ".join(f"{value:.6f}".rstrip("0").rstrip(".") for value in values)
