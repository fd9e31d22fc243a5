"""Set up .venv for `make demo` and, with the argument `dev`, for `make test`.

Missing system packages are installed where possible (Debian and Ubuntu; as root, or with a sudo that needs no
password); they are printed before. Elsewhere nothing is changed: the command that installs them is printed. Annotations
are quoted so that old Pythons can at least report that they are too old.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
MIN_PYTHON, MAX_PYTHON = (3, 11), (3, 13)
BIN = ROOT / ".venv" / "bin"


def check_python() -> None:
    """Stop if this Python is too old or too new for the wheels in constraints.txt."""
    if not MIN_PYTHON <= sys.version_info[:2] <= MAX_PYTHON:
        here = ".".join(map(str, sys.version_info[:3]))
        stop(
            f"scan2sim needs Python 3.11, 3.12 or 3.13; {sys.executable} is {here}.",
            "Install one of them; if it isn't found, give its path: make demo PYTHON=/path/to/python3.11",
        )


def missing_packages() -> "dict[str, str]":
    """Missing system libraries and features, and the Debian packages that contain them."""
    from scan2sim.pipeline.core import system_libs

    venv = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
    return system_libs.missing() | ({} if importlib.util.find_spec("ensurepip") else {"Python's venv": venv})


def install_system_packages(missing: "dict[str, str]") -> None:
    """Install missing packages, or stop with the command that installs them."""
    from scan2sim.pipeline.core import system_libs

    listed = ", ".join(f"{what} (package {package})" for what, package in missing.items())
    print(f"Missing on this system: {listed}", flush=True)
    root = root_prefix()
    if root is None or not shutil.which("apt-get"):
        stop("Run this command, then make again:", f"  {system_libs.command(missing)}")
    print("Installing these packages with apt-get as root ...", flush=True)
    apt = [*root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq", "-o", "Dpkg::Use-Pty=0"]
    subprocess.run([*apt, "update"], check=False)  # an outdated list may be sufficient
    done = subprocess.run(
        [*apt, "install", "--no-install-recommends", *missing.values()], stdout=subprocess.DEVNULL, check=False
    )
    if done.returncode or missing_packages():
        stop(f"The installation failed, still missing: {', '.join(missing_packages() or missing)}.",
             "Run this command, then make again:", f"  {system_libs.command(missing)}")  # fmt: skip


def root_prefix() -> "list[str] | None":
    """Prefix of commands to run as root: empty if we are root, sudo if it needs no password, None: not permitted."""
    if os.geteuid() == 0:
        return []
    allowed = shutil.which("sudo") and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0
    return ["sudo", "-n"] if allowed else None


def install_project(extra: "str | None") -> None:
    """Create .venv if missing, and install the project with an extra into it."""
    if not (BIN / "python").exists():
        subprocess.run([sys.executable, "-m", "venv", str(ROOT / ".venv")], check=True)
    print("Installing scan2sim and its dependencies into .venv; this takes some minutes ...", flush=True)
    pip = [str(BIN / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if not os.environ.get("PYTHONDONTWRITEBYTECODE"):  # of 22,000 modules, few are ever imported: compiled only then
        pip.append("--no-compile")
    project = f"{ROOT}[{extra}]" if extra else str(ROOT)
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), "-e", project], check=True)


def remove_compiled_kernels() -> None:
    """Remove kernels compiled from older code: numba can't read those of renamed modules."""
    for package in ("pipeline", "segmentation", "slam", "texturing", "data_samples"):
        for compiled in (ROOT / package).rglob("__pycache__/*.nb[ci]"):
            compiled.unlink(missing_ok=True)


def stop(*lines: str) -> NoReturn:
    """Exit with lines on standard error."""
    sys.exit("\n".join(lines))


def main() -> None:
    """Run all steps in order."""
    check_python()
    missing = missing_packages()
    if missing:
        install_system_packages(missing)
    try:
        install_project(sys.argv[1] if len(sys.argv) > 1 else None)
        remove_compiled_kernels()
    except subprocess.CalledProcessError as error:
        stop(f"{' '.join(error.cmd)} failed, see its output above. Fix the cause, then make again.")


if __name__ == "__main__":
    main()
