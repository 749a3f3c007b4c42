"""Whether the tool touches the work: the contact state c of Dressler 2012, (8.3) and Figure 8.2, with hysteresis.

The thesis does not print how c is found. Here contact begins above one threshold and ends below a lower one, after a short
wait, so that noise cannot toggle it, or at once when the hand pulls the tool away harder than the release force (8.4's
text); then it does not begin again before the tool is clear.
"""

from __future__ import annotations


class ContactState:
    """Follows the contact, sample by sample."""

    def __init__(self, begin: float, end: float, release: float, wait: int) -> None:
        """Keep thresholds.

        Args:
            begin: Load at which contact begins, as a share of the caller's scale.
            end: Load below which it ends.
            release: The hand's pull along the normal that ends it at once [N].
            wait: Samples below `end` before it ends.
        """
        self._begin, self._end, self._release, self._wait = begin, end, release, wait
        self._quiet, self._released = 0, False
        self.touching = False

    def update(self, load: float, pull: float) -> bool:
        """Return whether the tool touches, from the load on the tool and the hand's pull along the normal [N]."""
        self._quiet = self._quiet + 1 if load < self._end else 0
        self._released = self._released and self._quiet < self._wait
        if self.touching:
            self._released = pull > self._release
            self.touching = not self._released and self._quiet < self._wait
        else:
            self.touching = load > self._begin and not self._released
        return self.touching
