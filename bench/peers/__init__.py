"""Comparisons of edgeperc with other engines, numpy, other trackers and the limits of the machine.

``edgeperc-bench peers`` runs `turns`. Three modules are commands of their own: ``python -m
edgeperc_bench.peers.ground``, ``python -m edgeperc_bench.peers.projection`` and ``python -m
edgeperc_bench.peers.tracking``; each explains its options with ``--help``.
"""
