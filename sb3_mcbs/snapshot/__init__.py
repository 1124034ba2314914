"""Exact snapshots of environments."""

from sb3_mcbs.snapshot.bullet import BulletAdapter, ServerAdapter, is_server
from sb3_mcbs.snapshot.bullet_handles import uses_bullet
from sb3_mcbs.snapshot.divergence import SIMULATION_DIVERGED
from sb3_mcbs.snapshot.dm_control import PhysicsAdapter, is_physics
from sb3_mcbs.snapshot.errors import SnapshotError, SnapshotMismatchError, SnapshotUnsupportedError
from sb3_mcbs.snapshot.mujoco import MjDataAdapter, MjModelAdapter, is_data, is_model
from sb3_mcbs.snapshot.registry import SnapshotAdapter, register_adapter
from sb3_mcbs.snapshot.replay import Box2DAdapter, ReplayAdapter, renew_world, uses_box2d
from sb3_mcbs.snapshot.wrapper import Snapshot, SnapshotEnvWrapper

register_adapter(is_physics, PhysicsAdapter())
register_adapter(is_server, ServerAdapter())
register_adapter(uses_bullet, BulletAdapter())
register_adapter(uses_box2d, Box2DAdapter(prepare=renew_world))
register_adapter(is_model, MjModelAdapter())
register_adapter(is_data, MjDataAdapter())

__all__ = [
    "SIMULATION_DIVERGED",
    "BulletAdapter",
    "ReplayAdapter",
    "Snapshot",
    "SnapshotAdapter",
    "SnapshotEnvWrapper",
    "SnapshotError",
    "SnapshotMismatchError",
    "SnapshotUnsupportedError",
    "register_adapter",
]
