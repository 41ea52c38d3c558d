"""Memory of a GPU whose threads must not race."""

import numpy as np

WARP = 32


class Fault(Exception):
    """A kernel does what a GPU would not forgive."""


class Clocks:
    """Which barriers of the other warps of a block each warp knows of.

    A warp knows what another one did before the last barrier of both. Of its own lanes it knows
    what they did before its last barrier.
    """

    def __init__(self, warps):
        self.time = np.ones(warps, np.int32)
        self.known = np.zeros((warps, warps), np.int32)

    def barrier(self, warps):
        """Let some warps wait for each other."""
        self.known[np.ix_(warps, warps)] = self.time[warps]
        self.known[warps] = self.known[warps].max(0)
        self.time[warps] += 1


class Memory:
    """An array, or shared memory, and who accessed each of its words when."""

    def __init__(self, array):
        assert array.flags.c_contiguous
        self.words = array.reshape(-1).view(f"u{array.itemsize}")
        # Numbers of blocks from 1; of several readers, -1.
        self.changed_by, self.read_by = np.zeros((2, self.words.size), np.int32)

    def enter(self, number, clocks):
        """Begin with a block, whose threads know nothing of what those of other blocks do."""
        size, warps = self.words.size, len(clocks.time)
        self.block, self.clocks = number + 1, clocks
        # Threads from 1, and the times of their warps; of several readers in a warp, -1.
        self.writer, self.written = np.zeros((2, size), np.int32)
        self.reader, self.read = np.zeros((2, size, warps), np.int32)

    def places(self, addresses, size):
        """Return the words at some addresses, by the size of what is accessed."""
        if size != self.words.itemsize:
            raise Fault(f"{size} bytes of an array of words of {self.words.itemsize}")
        if (addresses % np.uint64(size)).any():
            raise Fault("misaligned")
        places = addresses // np.uint64(size)
        if (places >= self.words.size).any():
            raise Fault(f"beyond the {self.words.size} words of an array")
        return places.astype(np.int64)

    def load(self, threads, places):
        """Let threads read words."""
        self._check_writers(threads, places)
        self._check_blocks(self.changed_by[places])
        readers = self.read_by[places]
        self.read_by[places] = np.where((readers == 0) | (readers == self.block), self.block, -1)
        warp = threads // WARP
        now = self.clocks.time[warp]
        several = (self.read[places, warp] == now) & (self.reader[places, warp] != threads + 1)
        self.reader[places, warp] = np.where(several, -1, threads + 1)
        self.read[places, warp] = now
        # Lanes that read one word together.
        clash = self.reader[places, warp] != threads + 1
        self.reader[places[clash], warp[clash]] = -1
        return self.words[places]

    def store(self, threads, places, words):
        """Let threads write words; writing what is there already disturbs nobody."""
        changed = self.words[places] != words
        self.words[places] = words
        if (self.words[places] != words).any():
            raise Fault("a race: threads write different numbers together")
        threads, places = threads[changed], places[changed]
        self._check_writers(threads, places)
        self._check_blocks(self.changed_by[places])
        self._check_blocks(self.read_by[places])
        warp = threads // WARP
        late = self.read[places] > self.clocks.known[warp]
        late[np.arange(len(places)), warp] &= self.reader[places, warp] != threads + 1
        if late.any():
            raise Fault("a race: another thread reads it before the same barrier")
        self.writer[places], self.written[places] = threads + 1, self.clocks.time[warp]
        self.changed_by[places] = self.block

    def _check_writers(self, threads, places):
        writer = self.writer[places]
        other = (writer > 0) & (writer != threads + 1)
        known = self.clocks.known[threads // WARP, np.where(other, writer - 1, 0) // WARP]
        if (other & (self.written[places] > known)).any():
            raise Fault("a race: another thread writes it before the same barrier")

    def _check_blocks(self, users):
        if ((users != 0) & (users != self.block)).any():
            raise Fault("a race: another block accesses it")
