"""The package on aarch64, emulated by qemu: ``python -m tests.arm``; see ``docs/howto/hardware.md``."""
