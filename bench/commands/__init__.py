"""The commands of `edgeperc-bench`, one file each: `add_parser` declares a command, `run_command` carries it out."""
