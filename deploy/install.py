"""Sets up .venv: `make demo` and `make test` call this; the latter with `dev`, for what tests need besides.

What the system lacks is installed where that is allowed (Debian and Ubuntu; root, or a sudo that asks for no
password), and said before. Elsewhere nothing is touched: the command that installs it is printed. Old Pythons get as
far as being told so: annotations that they don't know are quoted.
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
OLDEST, NEWEST = (3, 11), (3, 13)
BIN = ROOT / ".venv" / "bin"


def check_python() -> None:
    """Stop if this Python is too old or too new for the wheels in constraints.txt."""
    if not OLDEST <= sys.version_info[:2] <= NEWEST:
        here = ".".join(map(str, sys.version_info[:3]))
        stop(
            f"scan2sim needs Python 3.11, 3.12 or 3.13; {sys.executable} is {here}.",
            "Install one of them, and name it if it isn't found: make demo PYTHON=/path/to/python3.11",
        )


def lacking() -> "dict[str, str]":
    """What the system lacks, and Debian's packages that hold it."""
    from scan2sim.pipeline.core import system_libs

    venv = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
    return system_libs.missing() | ({} if importlib.util.find_spec("ensurepip") else {"Python's venv": venv})


def install_system_packages(wanted: "dict[str, str]") -> None:
    """Install what the system lacks, or stop and say what would."""
    from scan2sim.pipeline.core import system_libs

    print("This system lacks", ", ".join(f"{what} (package {package})" for what, package in wanted.items()), flush=True)
    root = may_be_root()
    if root is None or not shutil.which("apt-get"):
        stop("Run this, then make again:", f"  {system_libs.command(wanted)}")
    print("Installing these packages now, by apt-get as root ...", flush=True)
    apt = [*root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq", "-o", "Dpkg::Use-Pty=0"]
    subprocess.run([*apt, "update"], check=False)  # a list that is old may do
    done = subprocess.run(
        [*apt, "install", "--no-install-recommends", *wanted.values()], stdout=subprocess.DEVNULL, check=False
    )
    if done.returncode or lacking():
        stop(f"That didn't bring {', '.join(lacking() or wanted)}. Run this, then make again:",
             f"  {system_libs.command(wanted)}")  # fmt: skip


def may_be_root() -> "list[str] | None":
    """What makes a command root's: nothing if we are, sudo if it asks for no password; None: we may not."""
    if os.geteuid() == 0:
        return []
    allowed = shutil.which("sudo") and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0
    return ["sudo", "-n"] if allowed else None


def install_project(extra: "str | None") -> None:
    """Make .venv if there is none, and install the project with an extra into it."""
    if not (BIN / "python").exists():
        subprocess.run([sys.executable, "-m", "venv", str(ROOT / ".venv")], check=True)
    print("Installing scan2sim and what it needs into .venv; this takes some minutes ...", flush=True)
    pip = [str(BIN / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    project = f"{ROOT}[{extra}]" if extra else str(ROOT)
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), "-e", project], check=True)


def drop_compiled() -> None:
    """Remove kernels that were compiled by an earlier state of the code: numba can't read those of renamed modules."""
    for room in ("pipeline", "segmentation", "slam", "texturing", "data_samples"):
        for compiled in (ROOT / room).rglob("__pycache__/*.nb[ci]"):
            compiled.unlink(missing_ok=True)


def stop(*lines: str) -> NoReturn:
    """End with lines on standard error."""
    sys.exit("\n".join(lines))


def main() -> None:
    """All of it, in order."""
    check_python()
    wanted = lacking()
    if wanted:
        install_system_packages(wanted)
    try:
        install_project(sys.argv[1] if len(sys.argv) > 1 else None)
        drop_compiled()
    except subprocess.CalledProcessError as error:
        stop(f"{' '.join(error.cmd)} failed; what it says is above. Mend that, then make again.")


if __name__ == "__main__":
    main()
