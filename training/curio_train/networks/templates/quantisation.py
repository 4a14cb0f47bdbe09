"""Templates in few bytes: signed bytes with a scale, and product quantisation (Jégou et al. 2011)."""

import torch
from jaxtyping import Float, Int8, UInt8
from torch import Tensor

LARGEST_BYTE = 127
CODEWORDS = 256

_SAMPLES, _ROUNDS, _BATCH = 30_000, 8, 20_000
_SEED = 20_213


def to_bytes(values: Float[Tensor, "rows size"]) -> tuple[Int8[Tensor, "rows size"], Float[Tensor, " rows"]]:
    """Signed bytes and the scale of each row that makes numbers of them again."""
    scale = values.abs().amax(dim=1).clamp(min=1e-12) / LARGEST_BYTE
    return (values / scale[:, None]).round().to(torch.int8), scale


def to_codes(
    vectors: Float[Tensor, "num parts*size"], parts: int
) -> tuple[UInt8[Tensor, "num parts"], Float[Tensor, "parts codewords size"]]:
    """The nearest codeword of each part of each vector, and the codewords: k-means of a part's values."""
    random = torch.Generator().manual_seed(_SEED)
    codes, books = [], []
    for values in vectors.chunk(parts, dim=1):
        sample = values[torch.randperm(len(values), generator=random)[:_SAMPLES]]
        book = _k_means(sample, random)
        books.append(book)
        codes.append(_nearest(values, book).to(torch.uint8))
    return torch.stack(codes, dim=1), torch.stack(books)


def _k_means(values: Float[Tensor, "num size"], random: torch.Generator) -> Float[Tensor, "codewords size"]:
    book = values[torch.randint(len(values), (CODEWORDS,), generator=random)]
    for _ in range(_ROUNDS):
        nearest = _nearest(values, book)
        count = torch.bincount(nearest, minlength=CODEWORDS)[:, None]
        total = torch.zeros_like(book).index_add(0, nearest, values)
        book = torch.where(count > 0, total / count.clamp(min=1), book)
    return book


def _nearest(values: Tensor, book: Tensor) -> Tensor:
    squares = book.square().sum(dim=1)
    return torch.cat([(squares - 2 * some @ book.T).argmin(dim=1) for some in values.split(_BATCH)])
