"""Writes Parquet files that lie: pages, dictionaries, footers and statistics that declare what is not there.

    python hostile_parquet.py OUT_DIR

OUT_DIR/sound is a small LeRobot v3 folder; OUT_DIR/NAME.KIND.parquet is its data file (KIND data), table of episodes
(episodes) or table of tasks (tasks) with one lie. Needs pyarrow. The files under crates/gawm-dataset/tests/hostile_parquet
were written by it.
"""
import json, struct, sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

# Thrift's compact protocol, as a tree: a struct is {field: [type, value]}, a list [element type, values].
BOOL_TRUE, BOOL_FALSE, I8, I16, I32, I64, DOUBLE, BINARY, LIST, STRUCT = 1, 2, 3, 4, 5, 6, 7, 8, 9, 12


class Reader:
    def __init__(self, data, at=0):
        self.data, self.at = data, at

    def varint(self):
        value = shift = 0
        while True:
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def signed(self):
        n = self.varint()
        return (n >> 1) ^ -(n & 1)

    def value(self, kind):
        if kind in (BOOL_TRUE, BOOL_FALSE):
            return None
        if kind == I8:
            self.at += 1
            return self.data[self.at - 1]
        if kind in (I16, I32, I64):
            return self.signed()
        if kind == DOUBLE:
            self.at += 8
            return self.data[self.at - 8 : self.at]
        if kind == BINARY:
            n = self.varint()
            self.at += n
            return self.data[self.at - n : self.at]
        if kind == LIST:
            head = self.data[self.at]
            self.at += 1
            n = head >> 4
            n = self.varint() if n == 15 else n
            element = head & 15
            if element in (BOOL_TRUE, BOOL_FALSE):
                self.at += n
                return [element, list(self.data[self.at - n : self.at])]
            return [element, [self.value(element) for _ in range(n)]]
        assert kind == STRUCT, kind
        return self.struct()

    def struct(self):
        fields, last = {}, 0
        while True:
            head = self.data[self.at]
            self.at += 1
            if head == 0:
                return fields
            last = last + (head >> 4) if head >> 4 else self.signed()
            fields[last] = [head & 15, self.value(head & 15)]


def varint(n):
    out = bytearray()
    while n > 127:
        out.append(n & 127 | 128)
        n >>= 7
    out.append(n)
    return bytes(out)


def zigzag(n):
    return varint(2 * n if n >= 0 else -2 * n - 1)


class Raw(bytes):
    """Bytes that are written as they are."""


def encode(kind, value):
    if isinstance(value, Raw):
        return value
    if kind in (BOOL_TRUE, BOOL_FALSE):
        return b""
    if kind == I8:
        return bytes([value])
    if kind in (I16, I32, I64):
        return zigzag(value)
    if kind == DOUBLE:
        return value
    if kind == BINARY:
        return varint(len(value)) + value
    if kind == LIST:
        element, values = value
        n = len(values)
        head = bytes([n << 4 | element]) if n < 15 else bytes([0xF0 | element]) + varint(n)
        if element in (BOOL_TRUE, BOOL_FALSE):
            return head + bytes(values)
        return head + b"".join(encode(element, v) for v in values)
    out, last = b"", 0
    for field, (kind, value) in sorted(value.items()):
        out += bytes([(field - last) << 4 | kind]) if 0 < field - last < 16 else bytes([kind]) + zigzag(field)
        out += encode(kind, value)
        last = field
    return out + b"\0"


class File:
    """A Parquet file as footer and pages: column chunks are lists of [header, body]."""

    def __init__(self, path):
        data = Path(path).read_bytes()
        size = struct.unpack("<I", data[-8:-4])[0]
        self.footer = Reader(data, len(data) - 8 - size).struct()
        self.groups = []
        for group in self.footer[4][1][1]:
            chunks = []
            for chunk in group[1][1][1]:
                meta = chunk[3][1]
                at = meta.get(11, meta[9])[1]
                end, pages = at + meta[7][1], []
                while at < end:
                    reader = Reader(data, at)
                    header = reader.struct()
                    at = reader.at + header[3][1]
                    pages.append([header, data[reader.at : at]])
                chunks.append(pages)
            self.groups.append(chunks)

    def column(self, name, group=0):
        for chunk, pages in zip(self.footer[4][1][1][group][1][1][1], self.groups[group]):
            if b".".join(chunk[3][1][3][1][1]).decode().startswith(name):
                return chunk[3][1], pages
        raise KeyError(name)

    def bytes(self, footer_edit=None):
        out = bytearray(b"PAR1")
        for group, chunks in zip(self.footer[4][1][1], self.groups):
            for chunk, pages in zip(group[1][1][1], chunks):
                meta, start = chunk[3][1], len(out)
                for name in (10, 14):
                    meta.pop(name, None)
                for index in (4, 5, 6, 7):
                    chunk.pop(index, None)
                has_dictionary = 7 in pages[0][0]
                for i, (header, body) in enumerate(pages):
                    if i == int(has_dictionary):
                        meta[9] = [I64, len(out)]
                    out += encode(STRUCT, header) + body
                if has_dictionary:
                    meta[11] = [I64, start]
                meta[7] = [I64, len(out) - start]
        if footer_edit:
            footer_edit(self.footer)
        footer = encode(STRUCT, self.footer)
        return bytes(out + footer + struct.pack("<I", len(footer)) + b"PAR1")


ROWS, WIDTH = 40, 2


def sound(folder):
    for part in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    vectors = lambda k: pa.array([[k * i * 0.01 + j for j in range(WIDTH)] for i in range(ROWS)], pa.list_(pa.float32()))
    half = ROWS // 2
    index = [i % half for i in range(ROWS)]
    table = pa.table({
        "observation.state": vectors(1.0), "action": vectors(1.1), "timestamp": pa.array([i / 10 for i in index], pa.float32()),
        "frame_index": index, "episode_index": [i // half for i in range(ROWS)], "index": list(range(ROWS)), "task_index": [0] * ROWS})
    options = dict(compression="zstd", data_page_version="1.0", write_page_index=False)
    pq.write_table(table, folder / "data/chunk-000/file-000.parquet", **options)
    pq.write_table(table, folder.parent / "plain.parquet", use_dictionary=False, **options)
    episodes = pa.table({
        "episode_index": [0, 1], "tasks": [["lift the cup"]] * 2, "length": [half, half], "data/chunk_index": [0, 0], "data/file_index": [0, 0],
        "dataset_from_index": [0, half], "dataset_to_index": [half, ROWS], "meta/episodes/chunk_index": [0, 0], "meta/episodes/file_index": [0, 0]})
    pq.write_table(episodes, folder / "meta/episodes/chunk-000/file-000.parquet", **options)
    pq.write_table(pa.table({"task_index": [0], "task": ["lift the cup"]}), folder / "meta/tasks.parquet", **options)
    feature = lambda dtype, shape: {"dtype": dtype, "shape": shape, "names": None}
    info = {
        "codebase_version": "v3.0", "robot_type": "arm", "total_episodes": 2, "total_frames": ROWS, "total_tasks": 1, "chunks_size": 1000,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": 10, "splits": {"train": "0:2"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None,
        "features": {
            "observation.state": feature("float32", [WIDTH]), "action": feature("float32", [WIDTH]), "timestamp": feature("float32", [1]),
            "frame_index": feature("int64", [1]), "episode_index": feature("int64", [1]), "index": feature("int64", [1]), "task_index": feature("int64", [1])}}
    (folder / "meta/info.json").write_text(json.dumps(info, indent=1) + "\n")


BIG = 2**31 - 1


def set_page(column, which, edit, source):
    def lie(files):
        file = File(files[source])
        meta, pages = file.column(column)
        edit(pages[which][0], meta)
        return file.bytes()
    return lie


def header(*path):
    """Sets a field of a page header: header(2, BIG), header(7, 1, BIG)."""
    *fields, value = path
    def edit(head, _):
        for field in fields[:-1]:
            head = head[field][1]
        head[fields[-1]] = [I32, value]
    return edit


def footer(edit, source="data"):
    return lambda files: File(files[source]).bytes(edit)


def body(column, make, source="plain", encoding=None):
    """Replaces the body of a data page (uncompressed)."""
    def lie(files):
        file = File(files[source])
        meta, pages = file.column(column)
        content = make()
        page = pages[-1]
        page[0][2], page[0][3] = [I32, len(content)], [I32, len(content)]
        page[0].pop(4, None)
        if encoding is not None:
            page[0][5][1][2] = [I32, encoding]
        page[1] = content
        meta[4] = [I32, 0]
        return file.bytes()
    return lie


def each_column(footer_tree, edit):
    for group in footer_tree[4][1][1]:
        for chunk in group[1][1][1]:
            edit(chunk[3][1])


def groups(footer_tree, edit):
    edit(footer_tree[4][1][1])


def overlapping(footer_tree):
    """The same row group twice, with twice the rows."""
    groups(footer_tree, lambda g: g.append(g[0]))
    footer_tree[3] = [I64, 2 * ROWS]


def many_groups(footer_tree):
    groups(footer_tree, lambda g: g.extend([g[0]] * 50))
    footer_tree[3] = [I64, 51 * ROWS]


def deep_schema(footer_tree):
    """Groups in groups, 5,000 deep, in front of what the columns are."""
    element = lambda i: {3: [I32, 0], 4: [BINARY, b"g%d" % i], 5: [I32, 1]}
    leaf = {1: [I32, 1], 3: [I32, 0], 4: [BINARY, b"leaf"]}
    elements = footer_tree[2][1][1]
    elements[1:] = [element(i) for i in range(5_000)] + [leaf]
    elements[0][5] = [I32, 1]


def huge_list(footer_tree):
    """A list of schema elements that declares 2^31 of them."""
    footer_tree[2] = [LIST, Raw(bytes([0xFC]) + varint(BIG))]


def many_children(footer_tree):
    footer_tree[2][1][1][0][5] = [I32, BIG]


def zstd(data):
    return pa.compress(data, codec="zstd", asbytes=True)


def bomb(files):
    """A page of zeros: a gigabyte in some kilobytes, as honest as it is large."""
    file = File(files["plain"])
    meta, pages = file.column("episode_index")
    size = 1 << 30
    content = zstd(bytes(1 << 24)) * 64
    pages[-1][0][2], pages[-1][0][3] = [I32, size], [I32, len(content)]
    pages[-1][0].pop(4, None)
    pages[-1][1] = content
    meta[6] = [I64, size]
    return file.bytes()


def rows(n):
    """Everything counts n rows; the pages have 40."""
    def edit(footer_tree):
        footer_tree[3] = [I64, n]
        for group in footer_tree[4][1][1]:
            group[3] = [I64, n]
        each_column(footer_tree, lambda meta: meta.__setitem__(5, [I64, n]))
    return edit


def zeros(n_values):
    """A data page that has n zeros as one run of a dictionary index."""
    def lie(files):
        file = File(files["data"])
        for name in ("episode_index", "index", "frame_index", "task_index", "timestamp"):
            meta, pages = file.column(name)
            levels = varint(n_values << 1) + b"\1"
            content = struct.pack("<I", len(levels)) + levels + b"\1" + varint(n_values << 1) + b"\0"
            head = pages[-1][0]
            head[2], head[3] = [I32, len(content)], [I32, len(content)]
            head.pop(4, None)
            head[5][1][1] = [I32, n_values]
            pages[-1][1] = content
            pages[0][1] = pa.decompress(pages[0][1], decompressed_size=pages[0][0][2][1], codec="zstd", asbytes=True)
            pages[0][0][3] = [I32, len(pages[0][1])]
            pages[0][0].pop(4, None)
            meta[4] = [I32, 0]
        return file.bytes(rows(n_values))
    return lie


def delta(n):
    """DELTA_BINARY_PACKED with n values declared in blocks that are not there."""
    levels = varint(ROWS << 1) + b"\1"
    return lambda: struct.pack("<I", len(levels)) + levels + varint(128) + varint(4) + varint(n) + zigzag(0) + b"\0" * 16


LIES = {
    "page_declares_2gb.data": set_page("episode_index", -1, header(2, BIG), "plain"),
    "page_declares_negative_size.data": set_page("episode_index", -1, header(2, -1), "plain"),
    "page_stored_2gb.data": set_page("observation.state", -1, header(3, BIG), "plain"),
    "vector_page_declares_2gb.data": set_page("observation.state", -1, header(2, BIG), "plain"),
    "page_of_2g_values.data": set_page("episode_index", -1, header(5, 1, BIG), "plain"),
    "page_of_negative_values.data": set_page("episode_index", -1, header(5, 1, -5), "plain"),
    "dictionary_of_2g_values.data": set_page("episode_index", 0, header(7, 1, BIG), "data"),
    "dictionary_of_negative_values.data": set_page("episode_index", 0, header(7, 1, -1), "data"),
    "dictionary_declares_2gb.data": set_page("observation.state", 0, header(2, BIG), "data"),
    "unknown_encoding.data": set_page("episode_index", -1, header(5, 2, 99), "plain"),
    "unknown_page_type.data": set_page("episode_index", -1, header(1, 77), "plain"),
    "delta_of_2e62_values.data": body("episode_index", delta(2**62), encoding=5),
    "delta_of_2e31_values.data": body("episode_index", delta(2**31), encoding=5),
    "levels_longer_than_page.data": body("episode_index", lambda: struct.pack("<I", 2**32 - 1) + b"\0" * 8),
    "empty_page.data": body("episode_index", lambda: b""),
    "bomb_1gb.data": bomb,
    "rows_2e31.data": zeros(2**31 - 1),
    "rows_30_million.data": zeros(30_000_000),
    "footer_counts_2e62_rows.data": footer(rows(2**62)),
    "footer_counts_negative_rows.data": footer(rows(-7)),
    "column_counts_2e62_values.data": footer(lambda f: each_column(f, lambda m: m.__setitem__(5, [I64, 2**62]))),
    "column_declares_2e62_bytes.data": footer(lambda f: each_column(f, lambda m: m.__setitem__(6, [I64, 2**62]))),
    "column_declares_negative_bytes.data": footer(lambda f: each_column(f, lambda m: m.__setitem__(6, [I64, -1]))),
    "column_starts_at_2e62.data": footer(lambda f: each_column(f, lambda m: m.update({9: [I64, 2**62], 11: [I64, 2**62]}))),
    "column_starts_in_footer.data": footer(lambda f: each_column(f, lambda m: m.update({9: [I64, 900], 11: [I64, 900]}))),
    "column_starts_before_0.data": footer(lambda f: each_column(f, lambda m: m.update({9: [I64, -50], 11: [I64, -50]}))),
    "columns_share_pages.data": footer(lambda f: each_column(f, lambda m: m.update({9: [I64, 4], 11: [I64, 4]}))),
    "row_groups_overlap.data": footer(overlapping),
    "row_groups_51.data": footer(many_groups),
    "statistics_of_wrong_type.data": footer(lambda f: each_column(f, lambda m: m.__setitem__(12, [STRUCT, {1: [BINARY, b"x"], 2: [BINARY, b"yyy"], 3: [I64, -9], 5: [BINARY, b"z" * 33], 6: [BINARY, b""]}]))),
    "wrong_physical_type.data": footer(lambda f: each_column(f, lambda m: m.__setitem__(1, [I32, 6]))),
    "schema_5000_deep.data": footer(deep_schema),
    "schema_list_of_2e31.data": footer(huge_list),
    "schema_of_2g_children.data": footer(many_children),
    "no_row_groups.data": footer(lambda f: f.update({3: [I64, 0], 4: [LIST, [STRUCT, []]]})),
    "name_not_utf8.data": footer(lambda f: f[2][1][1][1].__setitem__(4, [BINARY, b"\xff\xfe"])),
    "arrow_schema_garbage.data": footer(lambda f: f.__setitem__(5, [LIST, [STRUCT, [{1: [BINARY, b"ARROW:schema"], 2: [BINARY, b"/////wAAAAAQAAAA"]}]]])),
    "episodes_page_declares_2gb.episodes": set_page("tasks", -1, header(2, BIG), "episodes"),
    "episodes_dictionary_of_2g.episodes": set_page("tasks", 0, header(7, 1, BIG), "episodes"),
    "episodes_count_2e62.episodes": footer(rows(2**62), "episodes"),
    "episodes_no_groups.episodes": footer(lambda f: f.update({3: [I64, 0], 4: [LIST, [STRUCT, []]]}), "episodes"),
    "tasks_page_declares_2gb.tasks": set_page("task", -1, header(2, BIG), "tasks"),
    "tasks_count_2e62.tasks": footer(rows(2**62), "tasks"),
}


def raw_lies(data):
    size = struct.unpack("<I", data[-8:-4])[0]
    yield "footer_of_4gb.data", data[:-8] + struct.pack("<I", 2**32 - 1) + b"PAR1"
    yield "footer_longer_than_file.data", data[:-8] + struct.pack("<I", len(data)) + b"PAR1"
    yield "footer_of_0.data", data[:-8] + struct.pack("<I", 0) + b"PAR1"
    yield "footer_encrypted.data", data[:-4] + b"PARE"
    # Structs in structs: field 2 of the footer as a list of lists of lists.
    yield "footer_20000_deep.data", b"PAR1" + b"\x19" + b"\x19" * 20_000 + struct.pack("<I", 20_001) + b"PAR1"
    yield "unknown_field_20000_deep.data", b"PAR1" + b"\xfc" * 20_000 + struct.pack("<I", 20_000) + b"PAR1"
    yield "two_footers.data", data + data[-8 - size :]
    yield "only_magic.data", b"PAR1" * 2


def main():
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    sound(out / "sound")
    files = {
        "data": out / "sound/data/chunk-000/file-000.parquet", "plain": out / "plain.parquet",
        "episodes": out / "sound/meta/episodes/chunk-000/file-000.parquet", "tasks": out / "sound/meta/tasks.parquet"}
    for name, lie in LIES.items():
        (out / f"{name}.parquet").write_bytes(lie(files))
    for name, data in raw_lies(files["data"].read_bytes()):
        (out / f"{name}.parquet").write_bytes(data)
    long = pq.read_table(files["episodes"]).set_column(1, "tasks", pa.array([["lift " * 12_000_000]] * 2))
    pq.write_table(long, out / "text_of_60mb.episodes.parquet", compression="zstd", write_statistics=False)
    (out / "unchanged.data.parquet").write_bytes(File(files["data"]).bytes())
    files["plain"].unlink()


main()
