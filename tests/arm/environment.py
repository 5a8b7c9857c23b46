"""Debian's Python for aarch64 and the wheels that edgeperc needs there, in one folder; nothing is installed."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent.parent
TOOLS = {"qemu-aarch64": "qemu-user", "apt-get": "apt", "dpkg-deb": "dpkg"}
# The same versions as here, so that only the processor differs.
RUNTIME = ("numpy", "numba", "llvmlite", "onnxruntime")
TESTING = ("filelock", "hypothesis", "pytest", "pytest-xdist", "shapely")
# The kernel's flags of the processors that qemu emulates. qemu before 8.1 shows the host's /proc/cpuinfo, with which
# onnxruntime for aarch64 crashes.
NO_DOT_PRODUCT = "fp asimd aes pmull sha1 sha2 crc32 cpuid"
DOT_PRODUCT = f"{NO_DOT_PRODUCT} atomics fphp asimdhp asimdrdm lrcpc dcpop asimddp"
CPUS = {
    "cortex-a53": ("0xd03", NO_DOT_PRODUCT),
    "neoverse-n1": ("0xd0c", DOT_PRODUCT),
    "max": ("0xd40", f"{DOT_PRODUCT} sha3 sha512 fcma jscvt sve sve2 svei8mm svebf16 i8mm bf16"),
}


def missing_tools() -> dict[str, str]:
    """Programs that are not installed, and the Debian package of each."""
    return {tool: package for tool, package in TOOLS.items() if shutil.which(tool) is None}


def cpuinfo(cpu: str) -> str:
    """What Linux shows of one core of a processor in /proc/cpuinfo."""
    part, features = CPUS[cpu]
    return f"processor\t: 0\nFeatures\t: {features}\nCPU implementer\t: 0x41\nCPU part\t: {part}\n"


class Environment:
    """An aarch64 system in a folder, which is kept between runs; other versions of the wheels replace those in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self._root, self._site, self._package = (self.folder / name for name in ("root", "site", "package"))

    def prepare(self) -> dict[str, str]:
        """Fetch what is missing; return the versions of the wheels. apt-get and pip check the SHA-256 of each file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if not (self._root / "complete").exists():
            self._fetch_system()
        versions = {name: importlib.metadata.version(name) for name in RUNTIME}
        stamp, wanted = self._site / "versions.json", json.dumps([self.python, versions, TESTING])
        if not stamp.exists() or stamp.read_text() != wanted:
            self._fetch_wheels(versions)
            stamp.write_text(wanted)
        self._link_package()
        return versions

    @property
    def python(self) -> str:
        """Version of the interpreter: ``"3.11"``."""
        return (self._root / "usr/bin/python3").readlink().name.removeprefix("python")

    def _fetch_system(self) -> None:
        """Debian's packages, from the same sources and with the same keys as those of this system."""
        apt = self.folder / "apt"
        for each in (self._root, apt):
            shutil.rmtree(each, ignore_errors=True)
        for name in ("state/lists/partial", "cache/archives/partial"):
            (apt / name).mkdir(parents=True)
        (apt / "state/status").touch()
        options = {
            "Dir::State": apt / "state",
            "Dir::State::status": apt / "state/status",
            "Dir::Cache": apt / "cache",
            "APT::Architecture": "arm64",
            "APT::Architectures::": "arm64",
            "APT::Sandbox::User": "root",  # another user cannot write to this folder
        }
        command = ["apt-get", "-qq", *(text for name, value in options.items() for text in ("-o", f"{name}={value}"))]
        run([*command, "update"])
        run([*command, "install", "--yes", "--no-install-recommends", "--download-only", "python3", "libstdc++6"])
        for file in sorted((apt / "cache/archives").glob("*.deb")):
            run(["dpkg-deb", "--extract", str(file), str(self._root)])
        shutil.rmtree(apt)
        (self._root / "proc").mkdir(exist_ok=True)
        (self._root / "complete").touch()

    def _fetch_wheels(self, versions: Mapping[str, str]) -> None:
        shutil.rmtree(self._site, ignore_errors=True)
        platforms = ("manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux2014_aarch64")
        run(
            [
                *(sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--only-binary", ":all:"),
                *("--target", str(self._site), "--python-version", self.python),
                *(text for name in platforms for text in ("--platform", name)),
                *("--constraint", str(REPOSITORY / "constraints.txt")),
                *(f"{name}=={version}" for name, version in versions.items()),
                *TESTING,
            ]
        )

    def _link_package(self) -> None:
        """The packages of the checkout by their installed names: links, so that nothing is built."""
        shutil.rmtree(self._package, ignore_errors=True)
        (self._package / "edgeperc").mkdir(parents=True)
        links = {f"edgeperc/{each.name}": each for each in (REPOSITORY / "edgeperc").iterdir()}
        links |= {"edgeperc/zoo": REPOSITORY / "models"}
        links |= {f"edgeperc_{name}": REPOSITORY / name for name in ("bench", "export")}
        for name, target in links.items():
            if target.name != "__pycache__":
                (self._package / name).symlink_to(target)

    def run(self, cpu: str, arguments: Sequence[str], options: Sequence[str] = ()) -> int:
        """Run Python on an emulated processor, in the folder, with options of qemu; return the exit code."""
        (self._root / "proc/cpuinfo").write_text(cpuinfo(cpu))
        interpreter = self._root / f"usr/bin/python{self.python}"
        command = ["qemu-aarch64", *options, "-cpu", cpu, "-L", str(self._root), str(interpreter), *arguments]
        return subprocess.run(command, cwd=self.folder, env=self._variables()).returncode

    def _variables(self) -> dict[str, str]:
        kept = {
            name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "NUMBA", "OPENBLAS"))
        }
        return {
            **kept,
            **ONE_THREAD,
            "EDGEPERC_CACHE_DIR": str(self.folder / "cache"),
            "NUMBA_CACHE_DIR": str(self.folder / "kernels"),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": f"{self._site}:{self._package}",
            "PYTHONSAFEPATH": "1",
        }


ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def run(command: Sequence[str]) -> None:
    """Run a program; raise RuntimeError with its output if it fails."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed with exit code {done.returncode}:\n{done.stdout[-4000:]}")
