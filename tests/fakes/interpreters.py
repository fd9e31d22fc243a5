"""Python interpreters by the ROS 2 transport that is installed for them."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.conftest import ROOT

ROS_PYTHON = ROOT / ".venv-ros" / "bin" / "python"
PYTHONS = {"cyclone": Path(sys.executable), "rclpy": ROS_PYTHON}
TRITON_PYTHON = ROOT / ".venv-triton" / "bin" / "python"
