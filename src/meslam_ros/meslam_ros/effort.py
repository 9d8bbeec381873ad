"""How much mapping a frame gets when the computer is slower than the camera."""

from __future__ import annotations

# So many pairs wait also when all goes well.
USUAL_QUEUE = 1
LESS = 0.8
MORE = 1.05
LEAST = 0.1


class MappingEffort:
    """Lowers the share of mapping steps while image pairs queue up, and raises it when they do not.

    Tracking every frame with a coarser map is worth more than dropping frames: what was not
    trained now is trained from the keyframes later.

    Attributes:
        share: of the configured steps, in [LEAST, 1].
    """

    def __init__(self) -> None:
        self.share = 1.0

    def update(self, waiting: int) -> float:
        """The share for the next frame.

        Args:
            waiting: image pairs in the queue.
        """
        factor = LESS if waiting > USUAL_QUEUE else MORE
        self.share = min(max(self.share * factor, LEAST), 1.0)
        return self.share
