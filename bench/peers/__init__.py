"""Comparisons of edgeperc with other engines, numpy, other trackers and the limits of the machine.

``edgeperc-bench peers`` runs `turns`. `family`, `ground`, `slam` and `tracking` are commands of their
own, such as ``python -m edgeperc_bench.peers.ground``; each explains its options with ``--help``.
"""
