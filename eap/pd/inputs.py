"""A consistent view of what user programs and services write, without ever waiting for them.

The engine copies their regions at the start of a cycle, but only when their sequence word moved,
and keeps the last whole copy when it finds a writer in the middle of writing.
"""

from __future__ import annotations

from eap.pd.image import Image
from eap.pd.spec import Writer
from eap.pd.words import StationWord

_TORN = int(StationWord.TORN)
_SERVICES = int(StationWord.SERVICES_SEQUENCE)
_APPLICATION = int(StationWord.APPLICATION_SEQUENCE)


class Inputs:
    """The station's variables as the cycle sees them.

    Attributes:
        memory: With variables at the same offsets as in the image.  What the engine itself writes
            must be read from there instead.
    """

    def __init__(self, image: Image) -> None:
        self._image = image
        self._words = image.words
        self.memory = memoryview(bytearray(image.layout.samples.last))
        self._regions = [
            (place.sequence, slice(place.offset, place.offset + place.size))
            for writer, place in image.layout.regions.items()
            if writer is not Writer.ENGINE and place.size
        ]
        self._seen = [-1] * len(self._regions)
        self._settled: tuple[int, ...] = ()
        """Both sequence words, when all that they guard has been copied."""
        for _, region in self._regions:
            self.memory[region] = image.memory[region]

    def reload(self) -> None:
        """Take what has been put into the image before anybody writes there."""
        for index, (sequence, region) in enumerate(self._regions):
            if self.memory[region] == self._image.memory[region]:
                self._seen[index] = self._words[sequence]
            else:
                self.memory[region] = self._image.memory[region]
                self._seen[index] = -1

    def refresh(self) -> bool:
        """Copy what changed; return whether anything did."""
        words = self._words
        sequences = words[_SERVICES], words[_APPLICATION]
        if sequences == self._settled:
            return False
        changed = self._copy_changed()
        if all(
            seen == sequences[sequence - _SERVICES]
            for (sequence, _), seen in zip(self._regions, self._seen, strict=True)
        ):
            self._settled = sequences
        return changed

    def _copy_changed(self) -> bool:
        words = self._words
        changed = False
        for index, (sequence, region) in enumerate(self._regions):
            before = words[sequence]
            if before == self._seen[index]:
                continue
            if before % 2:
                words[_TORN] += 1
                continue
            copy = bytes(self._image.memory[region])
            if words[sequence] != before:
                continue  # a new write began meanwhile; the next cycle has it
            self.memory[region] = copy
            self._seen[index] = before
            changed = True
        return changed
