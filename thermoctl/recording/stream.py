"""Reading an Arrow IPC stream that may end anywhere.

A stream is a schema message, one message a batch, and an end mark (ff ff ff ff 00 00 00 00). A recorder that
is killed leaves no end mark and perhaps half a message. Everything before is complete, because each message
carries its length. After a power cut the end of a message may be zeros, which Arrow reads as numbers. So our
batches carry a CRC-32 of every column (`crc32`, in the schema's order), and a batch that disagrees is
dropped.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from thermoctl.files.yamlfile import InputError

END = b"\xff\xff\xff\xff\x00\x00\x00\x00"
CRC = b"crc32"


def texts(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    """Return metadata of Arrow as texts."""
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (metadata or {}).items()}


def checksums(batch: pa.RecordBatch) -> bytes:
    """Return the CRC-32 of every column's numbers (float64, null as NaN), 4 bytes each, little endian."""
    numbers = (column.to_numpy(zero_copy_only=False) for column in batch.columns)
    return np.array([zlib.crc32(c.tobytes()) for c in numbers], dtype="<u4").tobytes()


@dataclass
class Stream:
    """An open stream: iterate for its batches.

    Afterwards `good_bytes` is the end of the last complete message. `whole` is true if the end mark was read;
    without it the writer was killed or is still writing."""

    path: Path
    schema: pa.Schema
    _source: pa.NativeFile
    _reader: pa.RecordBatchReader
    _decoded: list[int]
    good_bytes: int = field(default=0)
    whole: bool = field(default=False)

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        size = self._source.size()
        while True:
            try:
                batch, said = self._reader.read_next_batch_with_custom_metadata()
                batch.validate()
                if said and CRC in said:
                    crc = np.frombuffer(said[CRC], dtype="<u4")[self._decoded]
                    if checksums(batch) != crc.tobytes():
                        return
            except StopIteration:
                self.whole = self._source.tell() > self.good_bytes and size - self.good_bytes >= len(END)
                return
            except (pa.ArrowException, OSError, ValueError, IndexError):
                return
            self.good_bytes = self._source.tell()
            yield batch


def open_stream(path: str | Path, columns: Iterable[str] | None = None) -> Stream:
    """Open a stream, decoding `columns` only (None: all).

    Raises InputError when not even the schema is there."""
    path = Path(path)
    try:
        source = pa.memory_map(str(path))
        reader = pa.ipc.open_stream(source)
        names = reader.schema.names
        fields = list(range(len(names)))
        if columns is not None:
            wanted = set(columns)
            fields = [i for i, name in enumerate(names) if name in wanted]
            source = pa.memory_map(str(path))
            reader = pa.ipc.open_stream(source, options=pa.ipc.IpcReadOptions(included_fields=fields))
    except pa.ArrowException:
        raise InputError(
            f"{path}: no recording in it: it is of another format (`thermoctl recordings import --explain` reads those), "
            "or was cut before its first row"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: no recording in it: a name of a column is not text") from None
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror or e}") from None
    return Stream(path, reader.schema, source, reader, fields, good_bytes=source.tell())
