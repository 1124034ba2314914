"""Measurements that anyone can repeat: ``make bench-search`` and the like."""

#: As in RL Zoo's settings of TD3. It is here because the environment of SBX lacks what ``common`` imports.
NETWORKS = {"net_arch": [400, 300]}
