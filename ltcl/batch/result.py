# SPDX-License-Identifier: BSD-3-Clause
"""What compensating many frames returns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ltcl.batch.manifest import Record
from ltcl.transport import error_note


@dataclass(frozen=True, eq=False, repr=False)
class CompensatedFrames:
    """Result of `ltcl.batch.compensate_frames`.

    Attributes
    ----------
    folder : Path
        Holds the patterns and frames.json.
    video : Path or None
    gain : float
        Of all frames.
    records : tuple of Record
        One a frame, in order; those of earlier runs, too.
    solved : int
        Frames of this run.
    seconds : float
        That they took, reading and writing included.
    transport_error : float
        As in `ltcl.Compensation`: what is not in the errors of the records, where T is compressed.
    """

    folder: Path
    video: Path | None
    gain: float
    records: tuple[Record, ...]
    solved: int
    seconds: float
    transport_error: float = 0.0

    @property
    def frames_per_second(self) -> float:
        """Of this run; 0 where nothing was left to do."""
        return self.solved / self.seconds if self.solved else 0.0

    @property
    def worst(self) -> Record:
        """The frame with the largest error."""
        return max(self.records, key=lambda record: record.error)

    @property
    def most_clipped(self) -> Record:
        """The frame with the largest share of clipped values."""
        return max(self.records, key=lambda record: record.clipped)

    def __repr__(self) -> str:
        worst = self.worst
        off = f"at worst off by {worst.error:.2%}{error_note(self.transport_error)}, frame {worst.number}"
        return f"<ltcl CompensatedFrames {len(self.records)} in {self.folder}, {off}>"
