"""Recognise the columns of a recording: by unit, else by name in several languages and by values.

A unit is certain. A name is a guess, which the plant file marks `# confirm`. A column without a unit is never
taken as a power. If its name means a power, a parameter states how many watts one of its units is.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.table import Table
from thermoctl.units import conversion, dimension

UNITS = {
    "temperature": "degC",
    "power": "W",
    "current": "A",
    "voltage": "V",
    "force": "N",
    "torque": "N*m",
    "position": "m",
    "angle": "rad",
    "velocity": "m/s",
    "turning": "rad/s",
    "level": "m",
    "flow": "m^3/s",
    "duty": "1",
}
"""The unit of each kind in a plant file."""
KELVIN = (250.0, 400.0)  # temperatures without a unit that never leave this span are taken as kelvin
FULL_SCALE = 1.001  # largest value of a share over its full scale
COLDEST, HOTTEST = -90.0, 2000.0  # plausible temperatures of a sensor, degC
LEAST_ROWS = 8
_ENERGY = dimension("J")

# Stems are looked for in each word of a name; _WORDS are whole words. English, German, French, Italian,
# Spanish, Portuguese, Dutch, Swedish and Polish, without accents. The first kind that fits counts.
_STEMS = {
    "setpoint": "setpoint sollwert target consigne consigna riferimento streefwaarde borvarde",
    "": "humid feucht umidit humed pressure druck pression pressione presion resist widerstand energ status alarm "
    "fehler counter index irradi strahlung rayonnement solar lufter luefter ventil fanspeed quality",
    "temperature": "temperat thermoc thermom celsius fahrenheit teplot lampot",
    "torque": "torque drehmoment coppia koppel",
    "force": "force kraft fuerza forza forca kracht thrust",
    "velocity": "speed velocity geschwindig drehzahl vitesse velocit velocid snelheid hastighet predkosc omega",
    "flow": "inflow outflow durchfluss volumenstrom debit portata caudal vazao zufluss zulauf flode przeplyw flow",
    "level": "level fullstand fuellstand pegel niveau livello nivel niva poziom",
    "position": "position posizion posicion posicao pozycj displace deplace spostament desplaz deslocam verschieb "
    "verplaats stroke travel abstand distanc distanz",
    "voltage": "voltage volts spannung tension tensione tensao voltaj spanning spanning napieci",
    "current": "current strom courant corrente corriente stroom amper amps intensite intensidad natezen",
    "duty": "duty pwm tastgrad percent",
    "power": "power leistung puissance potenza potencia vermogen effekt watt",
}
_DEVICES = {  # names of devices; they count only if no other kind fits: "pump power" is a power
    "flow": "pump pompe pompa bomba",
    "position": "encoder",
    "power": "heat heiz chauff chaleur riscald calef calor aquec verwarm varme grzej grzan grzal warme waerme boiler "
    "kessel radiator furnace burner brenner relay relais ssr",
}
_WORDS = {
    "setpoint": "set sp soll ref setp",
    "": "fan id nr no count state energy kwh rh",
    "temperature": "t temp temps_c tc ntc rtd pt theta temperatur degc",
    "torque": "torque couple moment",
    "force": "f force",
    "velocity": "vel rpm speed",
    "flow": "flow qv",
    "level": "h level",
    "position": "x y z pos weg lage hub position course",
    "voltage": "u volt",
    "current": "i iq amp prad current",
    "duty": "duty pwm pct",
    "power": "p q pel moc power",
}
_ANGLES = "rad mrad urad deg degree degrees ° arcmin arcsec turn turns revolution rpm rps"
_SHARES = {1.0: "1", 100.0: "%"}  # ends of a duty's scale, and the unit
_AIR = (  # names of surroundings, the outermost first: the room of a building is a body, the weather is not
    "outside outdoor outdoors exterior extern esterno esterna externo externa exterieur exterieure dehors aussen "
    "buiten ute utomhus zewnatrz venkovni weather wetter",
    "amb ambient ambiant ambiante ambiental ambientale ambiente env environment surroundings umgebung umg omgeving "
    "omgivning otoczenie entorno tamb tenv tumg",
    "air luft aria aire ar lucht powietrze vzduch tair tluft",
    "room raum salle sala stanza zimmer kamer rum pokoj lab labor halle hall habitacion troom traum",
)
_AIR_STEMS = ("outdoor aussen exterieur", "ambient umgebung omgeving environ otocze entorn", "luft", "raum")
_ENDS = (  # units, each with the ends of names that mean it
    "degC c degc celsius | K k | W w watts | kW kw | mW mw | A a | mA ma | V v | mV mv | N n | mm mm | um um | "
    "% pct | l/min lpm"
)
_SUFFIX = {end: unit for unit, *ends in map(str.split, _ENDS.split("|")) for end in ends}


_PLAIN = str.maketrans("øłØŁ", "olOL") | str.maketrans({"ß": "ss", "θ": " theta "})
_SPELLED = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue"})


@dataclass(frozen=True)
class Column:
    """A column of a recording as a plant may read it.

    `kind`: a key of UNITS, "setpoint" or "" for unknown. `unit`: of its numbers, "" where nothing states one.
    `doubt`: the guess that a user has to confirm, or "". `outside`: 0, or for the surroundings' temperature a
    number that is largest for the one furthest out. `stated`: whether the file states the unit."""

    name: str
    kind: str
    unit: str
    doubt: str
    outside: int = 0
    stated: bool = False

    def keys(self, name: str) -> str:
        """Return the keys `unit` and `column` of the line of `name` in a plant file, without the braces."""
        own = UNITS[self.kind] if self.unit else ""
        odd = self.unit and not self.stated and self.unit != own
        column = f"{{name: {quoted(self.name)}, unit: {quoted(self.unit)}}}" if odd else quoted(self.name)
        keys = [f"unit: {own}"] if own else []
        return ", ".join([*keys, f"column: {column}"] if odd or not own or self.name != name else keys)

    def values(self, table: Table) -> np.ndarray:
        """Return its values (N,) in the unit of its kind, gaps filled. Raises InputError for few values."""
        scale, offset = conversion(self.unit, UNITS[self.kind]) if self.unit else (1.0, 0.0)
        values = scale * table.columns[self.name] + offset
        good = np.isfinite(values)
        if good.sum() < LEAST_ROWS:
            raise InputError(
                f"{table.path}: column '{self.name}' has {good.sum()} values; {LEAST_ROWS} or more were expected"
            )
        return np.interp(table.t, table.t[good], values[good])


def recognise(table: Table, stated: Mapping[str, str]) -> dict[str, Column]:
    """Return every column of a table. `stated`: units that the user gave, by column."""
    return {c: _column(table, c, stated.get(c, "")) for c in table.columns}


def words(name: str) -> list[str]:
    """Return the words of a column's name: lower case, without accents and digits; T1 is 't'."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", _ascii(name))
    return re.findall(r"[a-z]+", text.lower())


def _ascii(text: str) -> str:
    text = text.translate(_PLAIN)
    return "".join(c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))


def _column(table: Table, name: str, stated: str) -> Column:
    unit = stated or table.units.get(name, "")
    name_words = words(name)
    kind, outside = _kind_of_name(name_words), _outside(name_words)
    if unit:
        kind = _kind_of_unit(unit, kind)
        return Column(name, kind, unit, "", outside if kind == "temperature" else 0, not stated)
    if len(name_words) > 1 and (by_suffix := _SUFFIX.get(name_words[-1], "")) and kind not in ("setpoint",):
        # thermoctl's own names, coil_c, and those of many loggers
        by_unit = _kind_of_unit(by_suffix, kind)
        if kind in (by_unit, "", "temperature") or len(name_words[-1]) > 1:
            doubt = f"'{name}' has no unit; {by_suffix} by the end of its name"
            return Column(name, by_unit, by_suffix, doubt, outside if by_unit == "temperature" else 0)
    values = table.columns[name][np.isfinite(table.columns[name])]
    low, high = (float(values.min()), float(values.max())) if len(values) else (np.nan, np.nan)
    if kind == "temperature" or (outside and kind == ""):
        if not COLDEST <= low <= high <= HOTTEST:
            return Column(name, "", "", "")
        guess = "K" if KELVIN[0] <= low <= high <= KELVIN[1] else "degC"
        return Column(
            name, "temperature", guess, f"'{name}' has no unit; {guess} by its name and values", outside
        )
    if kind == "duty" or (kind == "power" and set(np.unique(values)) == {0.0, 1.0}):
        share = next((unit for full, unit in _SHARES.items() if low >= 0 and high <= full * FULL_SCALE), "")
        return Column(name, "duty", share, f"'{name}' has no unit; a share of full by its name and values")
    if kind == "power":
        return Column(name, "power", "", "")
    if kind in ("current", "voltage", "force", "torque"):
        return Column(name, kind, UNITS[kind], f"'{name}' has no unit; {UNITS[kind]} by its name")
    if kind in ("position", "velocity", "level", "flow"):
        return Column(name, kind, "", f"'{name}' has no unit; {kind} by its name")
    return Column(name, kind, "", "")


def _kind_of_name(found: Sequence[str]) -> str:
    for kind, stems in _STEMS.items():
        exact = _WORDS[kind].split()
        if any(w in exact or any(s in w for s in stems.split()) for w in found):
            power = [w for w in found if w in ("power", "leistung", "puissance", "potenza", "potencia")]
            return "power" if kind == "current" and power and found[-1] in power else kind
        if kind == "temperature" and any(
            w.startswith("temp") and w not in ("temps", "tempo") or w.endswith("temp") for w in found
        ):
            return kind
    return next((k for k, d in _DEVICES.items() if any(s in w for w in found for s in d.split())), "")


def _outside(found: Sequence[str]) -> int:
    for rank, (exact, stems) in enumerate(zip(_AIR, _AIR_STEMS, strict=True)):
        if any(w in exact.split() or any(s in w for s in stems.split()) for w in found):
            return len(_AIR) - rank
    return 0


def _kind_of_unit(unit: str, by_name: str) -> str:
    """Return the kind of a column with a unit; its name decides where the unit fits several kinds."""
    if by_name == "setpoint":
        return by_name
    try:
        wanted = dimension({"C": "degC", "F": "degF"}.get(unit, unit))
    except ValueError:
        return ""
    symbol = re.match(r"[^\W\d_]+|°", unit)
    if symbol and symbol[0] in _ANGLES.split() and wanted in (dimension("1"), dimension("Hz")):
        return "turning" if wanted else "angle"
    if not wanted:
        return "duty" if by_name in ("duty", "power", "flow") else ""
    if wanted == dimension("Hz"):
        return "turning" if unit == "1/min" or by_name == "velocity" else ""
    if wanted == dimension("m"):
        return "level" if by_name == "level" else "position"
    if wanted == _ENERGY:
        return "torque" if "N" in unit else ""
    if wanted == dimension("m^3/s"):
        return "flow"
    return next((k for k, u in UNITS.items() if k != "duty" and dimension(u) == wanted), "")


def quoted(text: str) -> str:
    """Return a text in double quotes, as YAML reads it."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def identifiers(columns: Sequence[str], taken: Collection[str] = ()) -> dict[str, str]:
    """Return a name of the plant language for each column, none of them `taken`."""
    names: dict[str, str] = {}
    last = [re.split(r"[./]", c)[-1] for c in columns]  # sensor.room, Model/T: without what is above it
    for c, end in zip(columns, last, strict=True):
        c_short = end if re.match(r"\D", end) and last.count(end) == 1 else c
        name = re.sub(r"\W+", "_", _ascii(c_short.translate(_SPELLED)), flags=re.ASCII).strip("_") or "x"
        name = f"q_{name}" if name[0].isdigit() or name in ("t", "pi") else name
        while name in names.values() or name in taken:
            name += "_2"
        names[c] = name
    return names


def noise(values: np.ndarray) -> str:
    """Return the keys `noise` and, of a coarse sensor, `resolution`, from the second differences."""
    steps = np.abs(np.diff(values))
    quantum = float(steps[steps > 0].min(initial=np.inf))
    spread = 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / 6**0.5
    if np.isfinite(quantum) and spread < quantum:
        return f", noise: {max(spread, quantum / 12**0.5):.2g}, resolution: {quantum:.4g}"
    return f", noise: {spread:.2g}" if spread > 0 else ""
