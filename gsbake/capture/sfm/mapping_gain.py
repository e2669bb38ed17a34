"""When mapping no longer gains photos: it is ended, and what it has found is taken.

Where photos contradict each other, incremental mapping starts model after model, each smaller than the best, or registers the same photos
again and again.
"""

from __future__ import annotations

from dataclasses import dataclass, field

#: Models in a row that stay smaller than the largest before them.
MAX_SMALLER_MODELS = 3
#: Registrations in one model, in photos of the capture.
MAX_REGISTRATIONS = 2.0
#: Photos that a model begins with.
FIRST_PHOTOS = 2


@dataclass
class MappingGain:
    """Registrations of incremental mapping of so many `photos`, as its callbacks report them; `registered` is that of the present model."""

    photos: int
    registered: int = FIRST_PHOTOS
    _sizes: list[int] = field(default_factory=list)
    _running: bool = False

    def model_begins(self) -> bool:
        """Note that a model begins; returns whether mapping shall end, since the last ones were all smaller than the best."""
        if self._running:
            self._sizes.append(self.registered)
        self._running, self.registered = True, FIRST_PHOTOS
        best = self._sizes.index(max(self._sizes)) if self._sizes else 0
        return len(self._sizes) - 1 - best >= MAX_SMALLER_MODELS

    def photo_registered(self) -> bool:
        """Note that a photo was registered; returns whether mapping shall end, since it registers photos again."""
        self._running, self.registered = True, self.registered + 1
        return self.registered > MAX_REGISTRATIONS * self.photos
