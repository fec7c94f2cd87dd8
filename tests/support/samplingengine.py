"""An engine that runs cycles of one station and samples them, when a test says so."""

from __future__ import annotations

from pathlib import Path

import msgspec

from eap.net.image_file import ImageFile, create_image, prepare_image
from eap.pd.image import Inputs, Sampler
from eap.pd.layout import plan_layout
from eap.pd.spec import StationSpec, VariableSpec, Writer
from eap.pd.words import StationWord

CYCLE_NS = 10_000_000


class SamplingEngine:
    """Counts in the variable ``ticks`` of a station; a cycle runs each 10 ms of its own time."""

    def __init__(self, path: Path, spec: StationSpec) -> None:
        self.spec = spec
        self.path = path
        self.attach(create_image(path, plan_layout(spec)))

    def attach(self, file: ImageFile) -> None:
        """Go on in another image."""
        self.file = file
        self.image = file.image
        self.sampler = Sampler(file.image, Inputs(file.image).memory)

    def change(self, *variables: VariableSpec) -> None:
        """Go on with *variables* in front of the others, in another image."""
        spec = msgspec.structs.replace(self.spec, variables=(*variables, *self.spec.variables))
        fresh = prepare_image(self.path, plan_layout(spec), self.file.generation + 1)
        fresh.move_to(self.path)
        self.file.retire()
        for word in (StationWord.CYCLE, StationWord.SAMPLED_UNTIL):
            fresh.image.words[word] = self.image.words[word]
        fresh.release()
        self.file.close()
        self.attach(fresh)

    def run(self, count: int = 1) -> None:
        """Run cycles."""
        for _ in range(count):
            words = self.image.words
            words[StationWord.CYCLE] += 1
            cycle = words[StationWord.CYCLE]
            with self.image.writing(Writer.ENGINE):
                self.image.write("ticks", cycle % 65536)
            self.sampler.end_cycle(cycle, cycle * CYCLE_NS)
