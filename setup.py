"""What pyproject.toml cannot say.

A wheel with compiled kernels is for one platform, and needs no numba. A release names its repository; package indexes
then show the readme with links into it.
"""

import os
import re
import sysconfig
from pathlib import Path

from setuptools import Distribution, setup

NUMBA = "numba>=0.59,<0.69"
# Those that another Python or processor left in a checkout are none for this one.
HAS_KERNELS = any(Path("edgeperc/system/compiled").glob(f"*{sysconfig.get_config_var('EXT_SUFFIX')}"))
# Such as https://github.com/OWNER/NAME, without a slash at its end; empty: no addresses, and links as in the checkout.
REPOSITORY = os.environ.get("EDGEPERC_REPOSITORY", "")


class Package(Distribution):
    """The package; setuptools asks whether its wheel is for one platform."""

    def has_ext_modules(self) -> bool:
        """Whether there is machine code in it."""
        return HAS_KERNELS


def readme() -> str:
    """The readme; its links lead to the files of this version in the repository."""
    text = Path("README.md").read_text("utf-8")
    if not REPOSITORY:
        return text
    (version,) = re.findall(r'^__version__ = "(.+)"$', Path("edgeperc/__init__.py").read_text("utf-8"), re.MULTILINE)
    text = re.sub(r"(!\[[^\]]*\]\()(?!\w+:)", rf"\1{REPOSITORY}/raw/v{version}/", text)
    return re.sub(r"((?<!!)\[[^\]]*\]\()(?!\w+:|#)", rf"\1{REPOSITORY}/blob/v{version}/", text)


PAGES = {"Source": "", "Issues": "/issues", "Changes": "/blob/main/CHANGELOG.md"}

setup(
    distclass=Package,
    install_requires=["numpy>=1.24", *([] if HAS_KERNELS else [NUMBA])],
    long_description=readme(),
    long_description_content_type="text/markdown",
    project_urls={name: f"{REPOSITORY}{page}" for name, page in PAGES.items()} if REPOSITORY else {},
)
