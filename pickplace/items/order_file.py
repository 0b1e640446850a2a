"""Files of orders: lists of items with sides in millimetres and weights, as CSV, or as the JSON of BED-BPP."""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from pickplace.common.files import MAX_TABLE_BYTES, csv_rows, read_text
from pickplace.common.validate import excerpt, expect, refuse_above, refuse_if, reword_errors, unique_keys
from pickplace.rules.item import MAX_GRAMS, NO_LIMIT

#: Name of a column -> the names that a file may have for it, in any case; a unit may follow, as in ``length/mm``.
NAMES = {
    "order": ("order", "order_id", "order_nr"),
    "id": ("id", "sku", "item"),
    "article": ("article",),
    "product_group": ("product_group",),
    "length": ("length", "l"),
    "width": ("width", "w", "d", "depth"),
    "height": ("height", "h"),
    "weight": ("weight", "gross_weight", "mass", "kg", "g"),
    "quantity": ("quantity", "qty", "count"),
    "target": ("target",),
    "max_load": ("max_load", "maximum_load"),
    "stackable": ("stackable",),
    "nothing_on_top": ("nothing_on_top",),
    "orientations": ("orientations", "orientation"),
}
SIDES = ("length", "width", "height")
#: An item's sides along x, y and z, for each way in which it may lie; it stands upright in the first two.
ORIENTATIONS = ("lwh", "wlh", "lhw", "hlw", "whl", "hwl")
#: Quarter turns about z that lead to an orientation, as a bit mask.
TURNS = {"lwh": 0b0101, "wlh": 0b1010}
#: Words for some of the orientations.
WORDS = {"any": ORIENTATIONS, "upright": ("lwh", "wlh"), "fixed": ("lwh",)}
YES_NO = {
    **dict.fromkeys(("yes", "y", "true", "1", "1.0"), True),
    **dict.fromkeys(("no", "n", "false", "0", "0.0"), False),
}
MILLIMETRES, GRAMS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}, {"g": 1.0, "kg": 1000.0}
UNITS: dict[str, dict] = {**dict.fromkeys(SIDES, MILLIMETRES), "weight": GRAMS, "max_load": GRAMS}
DEFAULT_WEIGHT = "kg"
#: Without such a column the plan is another one. So a name that begins like it is refused if the column is missing.
OPTIONAL = ("quantity", "max_load", "stackable", "nothing_on_top", "orientations")
COLUMN = re.compile(r"(.*?)\s*(?:[/_ (\[]\s*(mm|cm|m|kg|g)\s*[)\]]?)?")  # a name, and a unit if there is one
EXPECTED = "columns length, width, height and weight, such as length/mm and weight/kg; and order, id or quantity if any"

MAX_LENGTH, MAX_LOAD = 10_000, 1_000_000_000  # of an item: 10 m; on it: 1,000 t
MAX_NAME = 100  # characters of the name of an order or an article
MAX_QUANTITY, MAX_ITEMS = 10_000, 2_000_000  # of a line, of a file


class OrderItem(NamedTuple):
    """One item of an order."""

    id: str  # of the article; without one, the article's name; "" if the file has neither
    length: float  # along x as it lies in the bin, mm
    width: float  # along y, mm
    height: float  # mm
    grams: int  # rounded up
    place: str  # the file and where in it, for messages, such as "orders.csv, line 7"
    max_load: int = NO_LIMIT  # greatest mass on top of it, g, rounded down
    orientations: tuple[str, ...] = ORIENTATIONS  # the allowed ones
    article: str = ""  # name, which BED-BPP has beside the id
    product_group: str = ""

    @property
    def kind(self) -> tuple:
        """Its size, weight and limits."""
        return *self[1:5], self.max_load, self.orientations

    @property
    def turns(self) -> int:
        """The quarter turns about z that are allowed, as a bit mask."""
        return sum(TURNS.get(each, 0) for each in self.orientations)

    @property
    def tipped_turns(self) -> tuple[int, int]:
        """The same for the item on its front, which is ``lhw`` without a turn, and on its side, which is ``whl``."""
        pairs = ORIENTATIONS[2:4], ORIENTATIONS[4:]
        first, second = (
            sum(turn for each, turn in zip(pair, TURNS.values(), strict=True) if each in self.orientations)
            for pair in pairs
        )
        return first, second

    @property
    def has_limits(self) -> bool:
        """Whether it bears only a limited load, or forbids a quarter turn about z on a face on which it may lie."""
        pairs = zip(ORIENTATIONS[::2], ORIENTATIONS[1::2], strict=True)
        return self.max_load < NO_LIMIT or any(len({*pair} & {*self.orientations}) == 1 for pair in pairs)


class Order(NamedTuple):
    """One order: its items in their order of arrival. Two orders may have one name, see :func:`read_orders`."""

    name: str
    items: list[OrderItem]


class _Row(NamedTuple):
    """A row of a file."""

    place: str
    header: tuple[str, ...]
    values: tuple
    header_place: str
    decimal: str = "."  # decimal separator that is accepted beside a point


class _Column(NamedTuple):
    key: str  # in the file
    unit: float  # of its values, in mm or g
    decimal: str  # decimal separator that is accepted beside a point

    def number(self, row: Mapping) -> float:
        """Return the value in a row as a number, in the unit of the column; raise ``ValueError`` if it is none."""
        value = row[self.key]
        refuse_if(isinstance(value, bool) or "_" in str(value), "no number, though Python takes it for one")
        if isinstance(value, str) and self.decimal == "," and self.unit == 1:  # mm or g: no three decimals
            refuse_if(re.fullmatch(r"\s*\d{1,3}([.,]\d{3})+\s*", value), "it may have separators of thousands")
        return float(value.replace(self.decimal, ".") if isinstance(value, str) else value)

    def expected(self, row: Mapping) -> str:
        """Return words for a number, which say what is wrong with the separators of the value in a row."""
        text = str(row[self.key])
        if self.decimal == "." and "," in text:
            return "a number with a decimal point"
        if self.decimal == "," and re.search(r"\d[.,]\d{3}", text):
            return "a number without separators of thousands" + " (three decimals look like one)" * (self.unit == 1)
        return "a number"


def read_orders(
    path, unit: str = "mm", key: str = "items.path", target: str | None = None, note: Callable[[str], Any] | None = None
) -> list[Order]:
    """Return the orders of a file.

    A CSV has a header and a line for each item, or for each article with its ``quantity``. Commas, semicolons or tabs
    separate the columns; with semicolons or tabs, decimals may have a comma. Lines with the same
    ``order`` are one order; without that column the whole file is one. JSON is that of BED-BPP: for each order
    ``item_sequence``, its items by their number. In the names that are returned, a control character is "?". Orders
    are told apart by their names in the file.

    Optional columns limit an item: ``max_load`` (empty: any), ``stackable`` or ``nothing_on_top`` (yes or no), and
    ``orientations`` (:data:`WORDS`, or some of :data:`ORIENTATIONS`).

    Args:
        path: the file; ``.json``, else CSV in UTF-8.
        unit: unit of lengths without one in the header, ``"mm"``, ``"cm"`` or ``"m"``. Weights without one are in kg.
        key: the setting that names the file.
        target: return only the orders with this value in the column ``target``, or in ``properties`` of BED-BPP; None:
            all.
        note: called with a sentence that lists the columns that are not read, if there are any.

    Raises:
        ValueError: naming the file, and the line of a value that cannot be used.
    """
    path = Path(path)
    refuse_if(
        not path.exists(), f"{key}={str(path)!r}: no such file; expected a CSV with {EXPECTED}; or BED-BPP's JSON."
    )
    text = read_text(path, MAX_TABLE_BYTES, "utf-8-sig", empty=False)
    rows = _rows_of_json(path, text) if path.suffix.lower() == ".json" else _rows_of_csv(path, text)
    orders: dict[str, list[OrderItem]] = {}
    articles: dict[str, OrderItem] = {}  # by id
    columns: dict[tuple[str, ...], dict[str, _Column]] = {}
    unread: dict[str, None] = {}
    total, targets = 0, dict[str, None]()
    for place, header, values, header_place, decimal in rows:
        if header not in columns:
            columns[header] = _read_header(f"{path}, {header_place}", header, unit, decimal)
            used = {column.key for column in columns[header].values()}
            unread |= dict.fromkeys(name for name in header if name and name not in used)
        row = dict(zip(header, values, strict=True))
        item, order, quantity = _read_row(f"{path}, {place}", row, columns[header])
        known = articles.setdefault(item.id, item)
        refuse_if(
            item.id and item.kind != known.kind,
            f"{item.place}: item {excerpt(item.id)} is {_words(item)}, but {_words(known)} in {known.place}; "
            "expected one size, weight and limits for each id.",
        )
        refuse_above(f"{path}:", total := total + quantity, "items", MAX_ITEMS)
        goal = _name(item.place, row, columns[header], "target")
        targets[goal] = None
        if target in (None, goal):
            shown = item._replace(id=_printable(item.id))
            orders.setdefault(order, []).extend([shown] * quantity)
    words = "" if target is None else f" for target={target}, but for {excerpt([*targets])}"
    refuse_if(not orders, f"{path}: no items{words}, expected at least one.")
    if len(orders) > 1 and "" in orders:
        raise ValueError(f"{orders[''][0].place}: its order has no name; expected one in each line, or in none.")
    if unread and note:
        note(f"{path}: not read: {', '.join(map(_printable, unread)):.500}.")
    return [Order(_printable(name), items) for name, items in orders.items()]


def _words(item: OrderItem) -> str:
    words = [f"{item.length:g} x {item.width:g} x {item.height:g} mm, {item.grams / 1000:g} kg"]
    if item.max_load < NO_LIMIT:
        words.append(f"at most {item.max_load / 1000:g} kg on top")
    if item.orientations != ORIENTATIONS:
        words.append(" ".join(item.orientations))
    return ", ".join(words)


def _rows_of_csv(path: Path, text: str) -> Iterator[_Row]:
    first = text.lstrip().partition("\n")[0]
    separator = max(",;\t", key=first.count)
    header: tuple[str, ...] = ()
    header_place = ""
    for line, row in csv_rows(path, text, separator):
        fields, place = tuple(row), f"line {line}"
        if not any(fields) or (not header and fields == ("sep=", "")):  # as a spreadsheet declares the separator
            continue
        if not header:
            header, header_place = fields, place
            continue
        count = len(fields)
        hint = "; decimals need a point" if count > len(header) >= 4 and separator == "," else ""
        hint = f"; {header_place} is taken for it" if len(header) == 1 else hint
        refuse_if(
            count != len(header),
            f"{path}, {place}: got {count} field{'s' * (count != 1)}, expected {len(header)} as in the header{hint}.",
        )
        yield _Row(place, header, fields, header_place, "." if separator == "," else ",")


def _rows_of_json(path: Path, text: str) -> Iterator[_Row]:
    def wrong(what: str) -> ValueError:
        return ValueError(
            f'{path}: {what}; expected {{order: {{"item_sequence": {{"1": item, ...}}}}}}, as of BED-BPP.'
        )

    with reword_errors((ValueError, RecursionError), lambda error: wrong(f"it cannot be read ({error})")):
        orders = json.loads(text, object_pairs_hook=unique_keys)
    if not isinstance(orders, dict):
        raise wrong(f"got {excerpt(orders)}")
    for name, order in orders.items():
        items = order.get("item_sequence") if isinstance(order, dict) else None
        if not isinstance(items, dict) or not all(number.isdecimal() and len(number) < 10 for number in items):
            raise wrong(f"order {excerpt(name)} has no item_sequence with numbers as its keys")
        if not items:
            raise wrong(f"order {excerpt(name)} has no items")
        if len({*map(int, items)}) < len(items):
            raise wrong(f"order {excerpt(name)} has two items with one number")
        properties = order.get("properties")
        about = {"target": properties.get("target")} if isinstance(properties, dict) else {}
        for number in sorted(items, key=int):
            if not isinstance(items[number], dict):
                raise wrong(f"order {excerpt(name)}, item {number} is {excerpt(items[number])}")
            repeated = {*NAMES["order"], "sequence"}
            own = {key: value for key, value in items[number].items() if _name_and_unit(key)[0] not in repeated}
            place, entries = f"order {_printable(name)}, item {number}", {**about, **own, "order": name}
            yield _Row(place, tuple(entries), tuple(entries.values()), place)


def _read_header(place: str, header: Sequence, unit: str, decimal: str) -> dict[str, _Column]:
    """Return the columns that a header names, by the names of :data:`NAMES`."""
    found: dict[str, tuple[str, str | None]] = {}
    similar: dict[str, str] = {}  # name of an optional column -> a name in the file that begins with it
    for key in header:
        name, suffix = _name_and_unit(key)
        known = name in {each for names in NAMES.values() for each in names}
        refuse_if(known and name in found, f"{place}: two columns {excerpt(name)}; expected one.")
        words = re.sub(r"[^a-z0-9]+", "_", name).strip("_") + "_"
        for column in OPTIONAL if not known else ():
            # Long names also without separators, such as MaxLoad.
            joined = words.replace("_", "")
            if any(
                words.startswith(f"{each}_") or (len(each) > 5 and joined.startswith(each.replace("_", "")))
                for each in NAMES[column]
            ):
                similar[column] = key
        found[name] = key, suffix
    # In l,w,h and length,width,height the width is the second side; in w,d,h and width,depth,height the first.
    is_second = {"length", "l"} & {*found} or not {"d", "depth"} & {*found}
    names_of = NAMES if is_second else NAMES | {"length": ("w", "width"), "width": ("d", "depth")}
    columns: dict[str, _Column] = {}
    unitless = []
    for column, names in names_of.items():
        given = [name for name in names if name in found]
        refuse_if(len(given) > 1, f"{place}: columns {' and '.join(map(excerpt, given))}; expected one of them.")
        for name in given:
            key, suffix = found[name]
            units = UNITS.get(column, {None: 1.0})
            suffix = suffix or (name if name in units else None)
            value = suffix or (unit if column in SIDES else DEFAULT_WEIGHT) if column in UNITS else None
            refuse_if(
                value not in units,
                f"{place}: the column {excerpt(key)} is in {value}; expected {' or '.join(map(str, units))}.",
            )
            columns[column] = _Column(key, units[value], decimal)
            unitless += [] if suffix else [column]
    for group in SIDES, ("weight", "max_load"):
        units_of = {column: columns[column].unit for column in group if column in columns}
        for column in [column for column in unitless if column in units_of and len({*units_of.values()}) > 1]:
            key = excerpt(columns[column].key)
            raise ValueError(f"{place}: the column {key} has no unit, but others have one; expected one in each.")
    for column, key in similar.items():
        in_units = " in g or kg" if column in UNITS else ""
        refuse_if(
            column not in columns,
            f"{place}: the column {excerpt(key)} is not known; expected {column}{in_units}.",
        )
    missing = [name for name in (*SIDES, "weight") if name not in columns]
    refuse_if(
        missing,
        f"{place}: no column {' and no '.join(missing)} in {excerpt(','.join(map(str, header)))}; expected {EXPECTED}.",
    )
    return columns


def _name_and_unit(key) -> tuple[str, str | None]:
    """Return the name of a column, in small letters with underscores, and its unit, if any."""
    match = COLUMN.fullmatch(" ".join(str(key).lower().split()))
    assert match  # it matches any text
    return match[1].replace(" ", "_").replace("-", "_"), match[2]


def _printable(name: str) -> str:
    """Return the beginning of a name from a file, with "?" for each control character or line break."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:MAX_NAME])


def _name(place: str, row: Mapping, columns: dict[str, _Column], column: str) -> str:
    """Return a name of a row as it stands in the file; "" if it has none. One that tells orders or articles apart must
    be short; others are cut."""
    if column not in columns:
        return ""
    key = columns[column].key
    text = "" if row[key] is None else str(row[key])
    if column in ("id", "order", "target"):
        expect(len(text) <= MAX_NAME, f"{place}: {key}", text, f"at most {MAX_NAME} characters")
    return text[:MAX_NAME]


def _read_row(place: str, row: Mapping, columns: dict[str, _Column]) -> tuple[OrderItem, str, int]:
    """Return the item of a row, the name of its order, and the number of such items."""

    def read(name: str, most: float) -> float:
        key, unit, _ = columns[name]
        with suppress(TypeError, ValueError, OverflowError):
            if 0 < (number := round(columns[name].number(row) * unit, 6)) <= most:
                return number
        expected = f"{columns[name].expected(row)} above 0, at most {most / unit:,.10g}"
        raise ValueError(f"{place}: {key}={excerpt(row[key])}: expected {expected}.")

    length, width, height = (read(name, MAX_LENGTH) for name in SIDES)
    grams = max(1, math.ceil(read("weight", MAX_GRAMS) - 1e-6))
    count = read("quantity", MAX_QUANTITY) if "quantity" in columns else 1.0
    refuse_if(count != int(count), f"{place}: {count:g} pieces; expected a whole number.")
    identity, order, *names = (_name(place, row, columns, name) for name in ("id", "order", "article", "product_group"))
    limits = _read_max_load(place, row, columns), _read_orientations(place, row, columns)
    return OrderItem(identity or names[0], length, width, height, grams, place, *limits, *names), order, int(count)


def _read_max_load(place: str, row: Mapping, columns: dict[str, _Column]) -> int:
    """Return the greatest mass on top of the item of a row, g."""
    loads = [NO_LIMIT]
    if "max_load" in columns and (value := row[columns["max_load"].key]) not in ("", None):
        key, unit, _ = columns["max_load"]
        load = math.nan
        with suppress(TypeError, ValueError, OverflowError):
            load = columns["max_load"].number(row) * unit
        refuse_if(
            not 0 <= load <= MAX_LOAD,
            f"{place}: {key}={excerpt(value)}: expected {columns['max_load'].expected(row)} from 0 to "
            f"{int(MAX_LOAD / unit):,}, or nothing.",
        )
        loads.append(math.floor(load + 1e-6))
    for column, forbids in (("stackable", False), ("nothing_on_top", True)):
        if column in columns and (value := row[columns[column].key]) not in ("", None):
            answer = YES_NO.get(str(value).strip().lower())
            refuse_if(answer is None, f"{place}: {columns[column].key}={excerpt(value)}: expected yes or no.")
            if answer == forbids:
                loads.append(0)
    return min(loads)


def _read_orientations(place: str, row: Mapping, columns: dict[str, _Column]) -> tuple[str, ...]:
    """Return the orientations that the item of a row allows."""
    value = row[columns["orientations"].key] if "orientations" in columns else None
    if value in ("", None):
        return ORIENTATIONS
    listed = value if isinstance(value, list) else [value]
    words = [word for each in listed for word in re.split(r"[\s,;|/+]+", str(each).lower()) if word]
    if not words:
        return ORIENTATIONS
    found = {each for word in words for each in WORDS.get(word, (word,))}
    refuse_if(
        not found <= {*ORIENTATIONS},
        f"{place}: {columns['orientations'].key}={excerpt(value)}: expected any, upright or fixed; or some of "
        f"{', '.join(ORIENTATIONS)}, the sides along x, y and z.",
    )
    return tuple(each for each in ORIENTATIONS if each in found)
