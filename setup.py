"""What pyproject.toml cannot say: a wheel with compiled kernels is for one platform, and needs no numba."""

from pathlib import Path

from setuptools import Distribution, setup

NUMBA = "numba>=0.59,<0.69"
HAS_KERNELS = any(file.suffix in (".so", ".pyd") for file in Path("edgeperc/system/compiled").glob("*"))


class Package(Distribution):
    """The package; setuptools asks whether its wheel is for one platform."""

    def has_ext_modules(self) -> bool:
        """Whether there is machine code in it."""
        return HAS_KERNELS


setup(distclass=Package, install_requires=["numpy>=1.24", *([] if HAS_KERNELS else [NUMBA])])
