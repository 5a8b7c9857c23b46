"""The commands of `edgeperc-bench`, one file each."""
