"""Sizes of the networks: what files of weights say of them, for torch modules and OpenVINO graphs alike."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Size:
    """Size of a `unet.UNet`: ``width`` channels at the top, doubled at each of ``levels`` halvings.

    ``fold`` x ``fold`` pixels are folded into channels first and unfolded at last (Shi et al. 2016), which makes small
    networks several times faster. 64, 4 and 1 are the classic one, `UNET64`. Raises ValueError on numbers below 1.
    """

    width: int = 32
    levels: int = 3
    fold: int = 2

    def __post_init__(self) -> None:
        if min(self.width, self.levels, self.fold) < 1:
            raise ValueError(f"expected a width, levels and fold of at least 1, found {self}")

    @property
    def multiple(self) -> int:
        """Pixels of which images are padded to multiples."""
        return self.fold << self.levels


#: The network of Ronneberger et al. 2015.
UNET64 = Size(64, 4, 1)


@dataclass(frozen=True)
class ResidualSize:
    """Size of a `unet.ResidualUNet`: ``width`` channels at the top, doubled at further levels; ``blocks`` per level.

    ``entry``: channels to which a 1x1 convolution brings the inputs first, 0 for none; where there are many inputs and
    few channels, most of the time goes into the first 3x3 convolution. Raises ValueError on sizes that cannot be built.
    """

    width: int = 32
    blocks: tuple[int, ...] = (1, 1, 1)
    entry: int = 0

    def __post_init__(self) -> None:
        if self.width < 1 or not self.blocks or min(*self.blocks, self.entry) < 0:
            raise ValueError(f"expected a width of at least 1, blocks per level and entry of at least 0, found {self}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of every level."""
        return tuple(self.width * 2**level for level in range(len(self.blocks)))

    @property
    def reach(self) -> int:
        """Pixels around an output that it depends on, at most."""
        counts = [2 * count for count in self.blocks[:-1]] + [self.blocks[-1]]
        blocks = sum(2 * count << level for level, count in enumerate(counts))
        # Besides: the entrance and the last block; a strided convolution, and a nearest neighbour, at every level.
        return 3 + blocks + 2 * (self.grid - 1)

    @property
    def grid(self) -> int:
        """Pixels after which the strided convolutions repeat."""
        return 1 << (len(self.blocks) - 1)
