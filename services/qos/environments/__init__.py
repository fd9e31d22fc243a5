"""Networks between a robot and its services for each environment (D3.2, section 2.2), one TOML file each."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io import toml
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.requirements import Environment

FOLDER = Path(__file__).parent


class Network(Params):
    """Link profiles from the robot to a service and back."""

    there: LinkProfile
    back: LinkProfile


def network(environment: Environment, file: Path | None = None) -> Network | None:
    """Network of an environment, as assumed or from a file; None if the service runs on the robot.

    Raises:
        InputError: the file can't be read or is invalid.
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
        raise InputError(path, f"invalid TOML ({error})", "Fix the file") from None
