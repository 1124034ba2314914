"""Measurements that anyone can repeat: ``make bench-search`` and the like."""
