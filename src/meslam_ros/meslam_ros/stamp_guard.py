"""Stamps that jump: believed when the next image pairs go on from there."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from meslam_ros.conversions import NANOSECONDS

RESTART_NS = NANOSECONDS
# A recording with one frame in two seconds has no gaps.
USUAL_GAPS = 5
# So many pairs must follow a jump. One back ends the map, and frames in random order follow one
# another now and then: of 400 streams of 60 frames, 3 seem to begin anew, with 3 followers 108.
FOLLOWERS_AHEAD, FOLLOWERS_BACK = 1, 5


class Verdict(Enum):
    """What a pair's stamp says."""

    GOES_ON = "goes on"
    BEGINS_ANEW = "begins anew"
    JUMPS = "jumps"
    IS_OLD = "does not grow: it differs"


@dataclass
class StampGuard:
    """Tells a recording that starts again, or a camera that paused, from a stamp that is wrong.

    A pair with a wrong stamp (zero, of another clock, bits flipped) must not end a map. So a jump
    back by more than a second, or ahead by more than that and several usual steps, counts only
    when the stamps of the next pairs follow it.

    Attributes:
        last_ns: stamp of the latest pair that was believed [ns]; None before the first.
    """

    last_ns: int | None = None
    _step_ns: int | None = None
    _jump_ns: int | None = None
    _followers: int = 0

    def judge(self, stamp_ns: int) -> Verdict:
        """What the next pair's stamp says [ns]; a jump is remembered."""
        last_ns, jump_ns = self.last_ns, self._jump_ns
        if last_ns is None:
            return self._believe(stamp_ns, None, Verdict.GOES_ON)
        step_ns = stamp_ns - last_ns
        if self._follows(last_ns, stamp_ns):
            return self._believe(stamp_ns, step_ns, Verdict.GOES_ON)
        if -RESTART_NS <= step_ns <= 0:
            self._jump_ns, self._followers = None, 0
            return Verdict.IS_OLD
        within_ns = max(RESTART_NS, 2 * (self._step_ns or 0))
        follows = jump_ns is not None and 0 < stamp_ns - jump_ns <= within_ns
        self._followers = self._followers + 1 if follows else 0
        self._jump_ns = stamp_ns
        back = stamp_ns < last_ns
        if self._followers < (FOLLOWERS_BACK if back else FOLLOWERS_AHEAD):
            return Verdict.JUMPS
        verdict = Verdict.BEGINS_ANEW if back else Verdict.GOES_ON
        return self._believe(stamp_ns, None, verdict)

    def _follows(self, before_ns: int, stamp_ns: int) -> bool:
        """Whether a stamp may be the next one; after the first any later one may."""
        if self._step_ns is None:
            return stamp_ns > before_ns
        return 0 < stamp_ns - before_ns <= max(RESTART_NS, USUAL_GAPS * self._step_ns)

    def _believe(self, stamp_ns: int, step_ns: int | None, verdict: Verdict) -> Verdict:
        self.last_ns = stamp_ns
        if step_ns is not None:
            self._step_ns = min(step_ns, self._step_ns or step_ns)
        self._jump_ns, self._followers = None, 0
        return verdict
