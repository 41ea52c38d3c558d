"""What a TensorBoard file holds."""

import struct

from tensorboardX.proto.event_pb2 import Event


def events(folder):
    """The events of the one event file of a folder.

    A record is its length (8 bytes), a checksum (4), the event, and a checksum (4).
    """
    (path,) = folder.iterdir()
    data = path.read_bytes()
    found = []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        found.append(Event.FromString(data[12 : 12 + length]))
        data = data[12 + length + 4 :]
    return found


def read_events(folder):
    """(step, name, value) of every scalar in the one event file of a folder."""
    return [
        (event.step, value.tag, value.simple_value)
        for event in events(folder)
        for value in event.summary.value
        if value.WhichOneof("value") == "simple_value"
    ]
