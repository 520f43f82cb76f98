"""Messages of binary logs, found and copied by compiled code: the inner loops of `dataflash` and `tlog`.

No loop reads beyond the file. What is no whole message is skipped byte by byte, and counted.
"""

from __future__ import annotations

import numpy as np

from usvlearn.core.jit import jit

HEAD = 0xA3, 0x95  # the first two bytes of each message of a DataFlash log
FMT, FMT_SIZE = 128, 89  # type and bytes of the message that describes the others
LAYOUTS = 4096  # most descriptions in one log; a boat needs some 200
V1, V2 = 0xFE, 0xFD  # the first byte of each MAVLink frame
STAMP = 8  # bytes before each frame of a telemetry log
SIGNED, SIGNATURE = 1, 13  # the flag of a frame with a signature, and its bytes
IDS = 1 << 16  # MAVLink's ids below this can be known


@jit(entry=True, memory=True)
def gather(data, starts, lengths, offset, size):
    """The same bytes of many messages, `(messages, size)` uint8; zeros beyond a message's end, as MAVLink 2 cuts them.

    The starts and lengths of the messages must lie within the file; `offset` and `size` are of the copied part, bytes.
    """
    gathered = np.zeros((len(starts), size), dtype=np.uint8)
    for k in range(len(starts)):
        for j in range(min(size, np.int64(lengths[k]) - offset)):
            gathered[k, j] = data[starts[k] + offset + j]
    return gathered


@jit(entry=True, memory=True)
def scan_dataflash(data, sizes):
    """All messages of a DataFlash log: places, layouts, descriptions, and what was skipped.

    A message counts if its type has been described, and another message or the end of the file follows it. `sizes` are
    the bytes of each format letter, `(256,)`; 0 for what is no letter.

    Returns:
        places: of each message, `(messages,)`, bytes from the start of the file.
        layouts: of each message, `(messages,)`, an index of `described`.
        described: place of the FMT message of each layout, `(layouts,)`; the first, FMT's own, is -1.
        skipped: bytes between messages that belong to none; the number of such gaps; the end of the last message.
    """
    places, layouts, count = np.empty(1024, np.int64), np.empty(1024, np.int16), 0
    described, known = np.full(LAYOUTS, -1, np.int64), 1
    lengths, current = np.zeros(256, np.int64), np.zeros(256, np.int16)
    lengths[FMT] = FMT_SIZE
    skipped = np.zeros(3, np.int64)
    place = 0
    while place + 3 <= len(data):
        end = place + lengths[data[place + 2]]
        if not (_head(data, place) and end > place and end <= len(data) and (end == len(data) or _head(data, end))):
            place += 1
            continue
        if place > skipped[2]:
            skipped[0], skipped[1] = skipped[0] + place - skipped[2], skipped[1] + 1
        if count == len(places):
            places, layouts = np.append(places, np.empty_like(places)), np.append(layouts, np.empty_like(layouts))
        places[count], layouts[count] = place, current[data[place + 2]]
        count += 1
        if data[place + 2] == FMT and known < LAYOUTS and _is_new(data, place, described[current[data[place + 3]]]):
            if data[place + 3] != FMT and _is_sound(data, place, sizes):
                described[known], current[data[place + 3]], lengths[data[place + 3]] = place, known, data[place + 4]
                known += 1
        place = end
        skipped[2] = end
    return places[:count].copy(), layouts[:count].copy(), described[:known].copy(), skipped


@jit(memory=True)
def _head(data, place):
    """Whether a message begins here, or the file ends within two bytes."""
    return place < len(data) and data[place] == HEAD[0] and (place + 1 == len(data) or data[place + 1] == HEAD[1])


@jit(memory=True)
def _is_new(data, place, before):
    """Whether an FMT message differs from the one at `before`."""
    if before < 0:
        return True
    for k in range(FMT_SIZE):
        if data[place + k] != data[before + k]:
            return True
    return False


@jit(memory=True)
def _is_sound(data, place, sizes):
    """Whether the length that an FMT message announces is that of its format letters."""
    total = 3
    for k in range(place + 9, place + 25):
        if data[k] == 0:
            break
        if sizes[data[k]] == 0:
            return False
        total += sizes[data[k]]
    return total == data[place + 4]


@jit(entry=True, memory=True)
def dataflash_stamps(data, places, layouts, offsets, widths, factors):
    """When each message was logged, `(messages,)` int64, us since boot; see `scan_dataflash`.

    A message without a stamp has that of the one before it, and those at the log's start have the first one. For each
    layout there are the offset of its stamp from the message's start, or -1, its bytes, 4 or 8, and the us in its unit.
    """
    stamps, last, stamped = np.zeros(len(places), np.int64), 0, False
    for k in range(len(places)):
        layout = layouts[k]
        if offsets[layout] >= 0:
            last = _little(data, places[k] + offsets[layout], widths[layout]) * factors[layout]
            if not stamped:
                stamps[:k], stamped = last, True
        stamps[k] = last
    return stamps


@jit(memory=True)
def _little(data, place, width):
    """An unsigned number, as int64."""
    number = np.int64(0)
    for k in range(width):
        number |= np.int64(data[place + k]) << (8 * k)
    return number


@jit(entry=True, memory=True)
def scan_tlog(data, extras):
    """All MAVLink frames of known messages in a telemetry log, and what was skipped.

    A frame of a known message counts if its checksum is right. One of an unknown message, which cannot be checked, is
    passed over if the frame before it was right, and another frame or the end of the file follows it. `extras` are
    the bytes that messages add to their checksums, `(IDS,)` int16; -1 for unknown ones.

    Returns:
        starts, lengths: of each payload, `(frames,)`, bytes.
        ids, senders: of each frame, `(frames,)`; a sender is 256 * system + component.
        stamps: before each frame, `(frames,)` int64, us since 1970.
        skipped: as of `scan_dataflash`; and the number of frames of unknown messages.
    """
    starts, stamps, count = np.empty(1024, np.int64), np.empty(1024, np.int64), 0
    lengths, ids, senders = np.empty(1024, np.uint8), np.empty(1024, np.int32), np.empty(1024, np.int32)
    skipped = np.zeros(4, np.int64)
    place = 0
    while place + STAMP + 8 <= len(data):
        frame = place + STAMP
        head = 10 if data[frame] == V2 else 6
        if (data[frame] != V2 and data[frame] != V1) or frame + head > len(data):
            place += 1
            continue
        last = int(frame + head + np.int64(data[frame + 1]))  # of the checksum; in plain Python bytes overflow
        end = last + 2 + (SIGNATURE if head == 10 and data[frame + 2] & SIGNED else 0)
        number = _little(data, frame + 7, 3) if head == 10 else np.int64(data[frame + 5])
        extra = np.int64(extras[number]) if number < IDS else np.int64(-1)
        if end > len(data):
            right = False
        elif extra < 0:
            right = place == skipped[2] and (end == len(data) or _frame(data, end + STAMP))
        else:
            right = _checksum(data, frame + 1, last, extra) == _little(data, last, 2)
        if not right:
            place += 1
            continue
        if place > skipped[2]:
            skipped[0], skipped[1] = skipped[0] + place - skipped[2], skipped[1] + 1
        place = skipped[2] = end
        if extra < 0:
            skipped[3] += 1
            continue
        if count == len(starts):
            starts, stamps = np.append(starts, np.empty_like(starts)), np.append(stamps, np.empty_like(stamps))
            lengths, ids = np.append(lengths, np.empty_like(lengths)), np.append(ids, np.empty_like(ids))
            senders = np.append(senders, np.empty_like(senders))
        sender = frame + head - (5 if head == 10 else 3)
        starts[count], lengths[count], ids[count] = frame + head, data[frame + 1], number
        senders[count] = 256 * np.int32(data[sender]) + data[sender + 1]
        stamps[count] = _big(data, frame - STAMP)
        count += 1
    return (
        starts[:count].copy(),
        lengths[:count].copy(),
        ids[:count].copy(),
        senders[:count].copy(),
        stamps[:count].copy(),
        skipped,
    )


@jit(memory=True)
def _frame(data, place):
    """Whether a frame begins here, or the file ends before."""
    return place >= len(data) or data[place] == V2 or data[place] == V1


@jit(memory=True)
def _big(data, place):
    """A stamp, whose first byte is the highest."""
    stamp = np.int64(0)
    for k in range(STAMP):
        stamp = stamp << 8 | np.int64(data[place + k])
    return stamp


@jit(memory=True)
def _checksum(data, start, end, extra):
    """X.25 (CRC-16/MCRF4XX) of some bytes and one more."""
    crc = np.int64(0xFFFF)
    for k in range(start, end):
        crc = _add(crc, np.int64(data[k]))
    return _add(crc, extra)


@jit(memory=True)
def _add(crc, byte):
    x = (byte ^ crc) & 0xFF
    x = (x ^ x << 4) & 0xFF
    return crc >> 8 ^ x << 8 ^ x << 3 ^ x >> 4
