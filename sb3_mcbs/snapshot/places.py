"""Views into simulators, named by where they lie in them.

The content of a view is the simulator's state. Which view an environment holds is its own state: one that
keeps ``data.xpos[target]`` exchanges it when it chooses another target.
"""

import operator
from collections.abc import Sequence
from typing import Any

from sb3_mcbs.snapshot.errors import SnapshotMismatchError
from sb3_mcbs.snapshot.registry import find_adapter

#: The number of a simulator among those of its environment, and what its adapter calls the place.
Place = tuple[int, Any]


class Places:
    """Where the views into some simulators lie.

    :param simulators: the objects that adapters capture, in the order in which they are met.
    """

    def __init__(self, simulators: Sequence[Any] = ()) -> None:
        self.simulators = simulators
        #: Whether anybody asked.
        self.asked = False

    def find(self, view: Any) -> Place | None:
        """Name the place of a view; None if it belongs to no simulator that names any.

        :param view: an array, or another object that a simulator hands out.
        """
        self.asked = True
        for number, simulator in enumerate(self.simulators):
            adapter = find_adapter(simulator)
            place = None if adapter is None else adapter.place_of(simulator, view)
            if place is not None:
                return number, place
        return None

    def view_at(self, place: Place | None, current: Any) -> Any:
        """Return the view at a place; what is there now if it lies there, or if nobody knows the place.

        :param place: of a view into these simulators, or into those of another instance.
        :param current: the view that is there now.
        :raises SnapshotMismatchError: if there is no such place, as in another model.
        """
        if place is None or place[0] >= len(self.simulators) or self.find(current) == place:
            return current
        simulator = self.simulators[place[0]]
        adapter = find_adapter(simulator)
        try:
            return current if adapter is None else adapter.view_at(simulator, place[1])
        except Exception as error:
            raise SnapshotMismatchError(
                f"The snapshot holds a view into a {type(simulator).__name__}, and that of this environment "
                f"has none at {place[1]}: {error}"
            ) from error

    def are_of(self, simulators: Sequence[Any]) -> bool:
        """Return whether these are the simulators that are there, or nobody asked.

        :param simulators: those that are there.
        """
        same = len(simulators) == len(self.simulators) and all(map(operator.is_, simulators, self.simulators))
        return same or not self.asked
