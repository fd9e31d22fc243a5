"""Networks between a robot and its services, by where those run (D3.2, section 2.2): a file each, of what it does."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io import toml
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.requirements import Environment

FOLDER = Path(__file__).parent


class Network(Params):
    """Both directions between a robot and a service: from the robot, and back to it."""

    there: Shape
    back: Shape


def network(environment: Environment, file: Path | None = None) -> Network | None:
    """What lies between robot and service, as assumed or as a file says; None: nothing does, on the robot.

    Raises:
        InputError: the file can't be read, or says something else.
    """
    if environment == Environment.ROBOT and file is None:
        return None
    path = file or FOLDER / f"{environment}.toml"
    try:
        return Network.model_validate(toml.parse(path.read_text("utf-8")))
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a file with [there] and [back]") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(path, f"{where}: {first['msg']}", f"See {FOLDER / 'cloud.toml'}") from None
    except ValueError as error:
        raise InputError(path, f"is no TOML ({error})", "Mend it") from None
