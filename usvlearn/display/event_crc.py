"""CRC-32C, the checksum of each record in TensorBoard's files (RFC 3720, appendix B.4), by compiled code.

TensorBoard computes it by a loop in Python, which takes longer than everything else around the replay of one boat.
"""

import numpy as np

from usvlearn.core.jit import jit

POLYNOMIAL, ONES = 0x82F63B78, 0xFFFFFFFF


def _table() -> np.ndarray:
    """The checksum of each byte."""
    crc = np.arange(256)
    for _ in range(8):
        crc = (crc >> 1) ^ (crc & 1) * POLYNOMIAL
    return crc


TABLE = _table()


@jit(entry=True)
def crc32c(data, table):
    """The checksum of bytes."""
    crc = ONES
    for byte in data:
        crc = table[(crc ^ np.int64(byte)) & 255] ^ (crc >> 8)
    return crc ^ ONES


def masked_crc32c(data: bytes) -> int:
    """The checksum as a record stores it: rotated, and a constant added.

    >>> hex(crc32c(np.frombuffer(b"123456789", np.uint8), TABLE)), hex(masked_crc32c(b"123456789"))
    ('0xe3069283', '0xc78ab0e5')
    """
    crc = int(crc32c(np.frombuffer(data, np.uint8), TABLE))
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & ONES
