"""Small files of our own, written after the manuals of loggers and programs, with what a reader has to find in them.

`python -m tests.recording.loggers` reads each and prints the table of docs/reference/loggers.md; --write writes the page.
"""

from __future__ import annotations

import gzip
import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from thermoctl.recording.foreign.logger import read_recording
from thermoctl.recording.table import Table

PAGE = Path(__file__).parents[2] / "docs/reference/loggers.md"
DATE = "2026-03-01"
T6 = [0.0, 1, 2, 3, 4, 5]
RISING = [20.0, 21, 22, 23, 24, 25]
POWER = [0.0, 0, 0, 1, 1, 1]


@dataclass(frozen=True)
class Case:
    """A file of a logger: its name, its content or a function that writes it, and the right answer."""

    logger: str
    file: str
    content: str | bytes | Callable[[Path], None]
    columns: Mapping[str, list[float]]
    t: list[float] = field(default_factory=lambda: list(T6))
    units: Mapping[str, str] = field(default_factory=dict)
    how: Mapping[str, object] = field(default_factory=dict)

    def written(self, folder: Path) -> Path:
        """Write the file and return its path."""
        path = folder / self.file
        if callable(self.content):
            self.content(path)
        else:
            path.write_bytes(self.content if isinstance(self.content, bytes) else self.content.encode())
        return path


def rows(head: str, row: str, count: int = 6, end: str = "") -> str:
    """Return a text of `count` rows: {i}, {T} (20 + i), {P} (0 0 0 1 1 1), {s} (seconds of a minute, two digits)."""
    lines = [
        row.format(i=i, T=20 + i, P=int(POWER[i]), s=f"{i:02d}", h=f"{i * 0.1:g}", k=i * 500)
        for i in range(count)
    ]
    return head + "\n".join(lines) + "\n" + end


def _tdms(path: Path) -> None:
    import nptdms

    begin = np.datetime64(f"{DATE}T10:00:00")
    wave = {"wf_increment": 1.0, "wf_start_offset": 0.0, "wf_start_time": begin, "unit_string": "°C"}
    late = wave | {"wf_start_time": begin + np.timedelta64(3, "s"), "unit_string": "mW"}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("rig", "T", np.array(RISING), wave),
                nptdms.ChannelObject("drive", "P", np.array([1.0, 1, 1]), late),
                nptdms.ChannelObject("rig", "Comment", np.array(["a", "b"])),
            ]
        )


def _tdms_time(path: Path) -> None:
    import nptdms

    times = np.datetime64(f"{DATE}T10:00:00", "us") + np.arange(6) * np.timedelta64(1, "s")
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("g", "Time", times), nptdms.ChannelObject("g", "T", np.array(RISING))]
        )


def _mdf(version: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import asammdf

        t = np.array(T6)
        with asammdf.MDF(version=version) as mdf:
            mdf.append([asammdf.Signal(np.array(RISING), t, name="T", unit="°C")])
            mdf.append([asammdf.Signal(np.array([5.0, 7.0]), np.array([0.0, 3.0]), name="P", unit="mW")])
            saved = mdf.save(path.with_suffix(".mf4" if version[0] == "4" else ".mdf"), overwrite=True)
        Path(saved).replace(path)

    return write


def _mdf_state(path: Path) -> None:
    import asammdf

    with asammdf.MDF(version="4.10") as mdf:
        t = np.array(T6)
        states = np.array([b"off", b"off", b"off", b"on", b"on", b"on"])
        mdf.append(
            [
                asammdf.Signal(np.array(RISING), t, name="T", unit="degC"),
                asammdf.Signal(states, t, name="P", encoding="utf-8"),
            ]
        )
        saved = mdf.save(path, overwrite=True)
    assert Path(saved) == path


def _excel(path: Path) -> None:
    from datetime import datetime, timedelta

    import openpyxl

    book = openpyxl.Workbook()
    book.active.title = "Info"
    sheet = book.create_sheet("Data")
    sheet.append(["Zeit", "T [°C]", "P"])
    for i in range(6):
        sheet.append([datetime(2026, 3, 1, 10) + timedelta(seconds=i), RISING[i], bool(POWER[i])])
    book.save(path)


def _parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    stamps = pa.array([1772359200000 + 1000 * i for i in range(6)], pa.timestamp("ms", "UTC"))
    table = pa.table(
        {"time": stamps, "T": RISING, "P": [bool(p) for p in POWER], "who": ["a"] * 6, "raw": [[1]] * 6}
    )
    pyarrow.parquet.write_table(table, path)


def _mat5(path: Path) -> None:
    from scipy.io import savemat

    savemat(path, {"t": np.array(T6), "T": np.array(RISING), "P": np.array(POWER), "title": "run"})


def _mat_dspace(path: Path) -> None:
    from scipy.io import savemat

    y = np.zeros(2, dtype=[("Name", "O"), ("Data", "O")])
    y[0], y[1] = ("Model/T", np.array(RISING)), ("Model/P", np.array(POWER))
    savemat(path, {"run": {"X": {"Data": np.array(T6)}, "Y": y}})


def _mat_table(path: Path) -> None:
    import warnings

    import matio
    import pandas as pd

    frame = pd.DataFrame(
        {"T": RISING, "P": POWER}, index=pd.to_timedelta(T6, unit="s").astype("timedelta64[ms]")
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(str(path), {"TT": frame}, version="v7.3")


_HA = [
    ("sensor.block", "20"),
    ("sensor.block", "unavailable"),
    ("sensor.block", "22"),
    ("switch.heater", "off"),
    ("switch.heater", "on"),
]
_HA_TIMES = [0, 1, 2, 0, 3]
_ISO = DATE + "T10:00:{:02d}.000Z"
_KLIPPER = "Stats {i}.0: gcodein=0  mcu: mcu_awake=0.01 freq=180000000 heater_bed: target=60 temp={T}.0 pwm=0.{P}00 sysload=0.4"

CASES = (
    Case("plain CSV", "t.csv", rows("t,T,P\n", "{i},{T},{P}"), {"T": RISING, "P": POWER}),
    Case("German Excel, CSV", "zeit.csv", rows("Zeit;T (°C);P [W]\n", "01.03.2026 10:00:{s};{T},0;{P}").encode("cp1252"),
         {"T": RISING, "P": POWER}, units={"T": "degC", "P": "W"}),
    Case("pandas to_csv, index of dates", "pandas.csv", rows(",T,P\n", DATE + " 10:00:{s},{T},{P}"), {"T": RISING, "P": POWER}),
    Case("numpy.savetxt with a header", "numpy.txt", rows("# time T P\n", "{i:.18e} {T:.18e} {P:.18e}").replace("{P:.18e}", ""),
         {"T": RISING, "P": POWER}),
    Case("numpy.savetxt without a header", "bare.txt", rows("", "{i}.0 {T}.0 {P}.0"), {"column_2": RISING, "column_3": POWER}),
    Case("gnuplot, columns of blanks", "gnuplot.dat", rows("# t[s]  T[degC]   P[W]\n", "  {i}.0   {T}.0    {P}"),
         {"T": RISING, "P": POWER}, units={"T": "degC", "P": "W"}),
    Case("MATLAB writetable", "matlab.csv", rows("Time,T,P\n", "01-Mar-2026 10:00:{s},{T},{P}"), {"T": RISING, "P": POWER}),
    Case("MATLAB writetimetable", "timetable.csv", rows("Time,T,P\n", "{i} sec,{T},{P}"), {"T": RISING, "P": POWER}),
    Case("MATLAB .mat 5", "m5.mat", _mat5, {"T": RISING, "P": POWER}),
    Case("MATLAB .mat 7.3, timetable", "m73.mat", _mat_table, {"T": RISING, "P": POWER}),
    Case("LabVIEW LVM", "run.lvm", rows(
        "LabVIEW Measurement\t\nWriter_Version\t2\t\nSeparator\tTab\n***End_of_Header***\t\n\nChannels\t2\t\t\nSamples\t6\t6\t\n"
        "Y_Unit_Label\tWatts\tDeg C\t\nX0\t0.0E+0\t0.0E+0\t\nDelta_X\t0.1\t0.1\t\n***End_of_Header***\t\t\t\n"
        "X_Value\tP\tT\tComment\n", "{h}\t{P}\t{T}\t"), {"T": RISING, "P": POWER}, [0, 0.1, 0.2, 0.3, 0.4, 0.5], {"P": "W", "T": "degC"}),
    Case("LabVIEW TDMS, waveforms", "wave.tdms", _tdms, {"T": RISING, "P": [np.nan] * 3 + [1, 1, 1]}, units={"T": "degC", "P": "mW"}),
    Case("LabVIEW TDMS, a channel of times", "time.tdms", _tdms_time, {"T": RISING}),
    Case("Campbell TOA5", "CR1000.dat", rows(
        '"TOA5","site","CR1000","7","CR1000.Std.03","CPU:p.CR1","1","T"\n"TIMESTAMP","RECORD","T_Avg","P"\n"TS","RN","Deg C","W"\n"","","Avg","Smp"\n',
        '"' + DATE + ' 10:00:{s}",{i},{T},{P}'), {"T_Avg": RISING, "P": POWER}, units={"T_Avg": "degC", "P": "W"}),
    Case("Onset HOBO", "hobo.csv", rows(
        '"Plot Title: block"\n"#","Date Time, GMT+01:00","Temp, °C (LGR S/N: 10, SEN S/N: 10)","Coupler Attached (LGR S/N: 10)"\n',
        "{i},03/01/26 10:00:{s} AM,{T}.0,", end="7,03/01/26 10:00:06 AM,,Logged\n"), {"Temp": [*RISING, np.nan]}, [*T6, 6], {"Temp": "degC"}),
    Case("Lascar EL-USB", "lascar.txt", f"EL-USB-1,Time,Celsius(°C),Serial Number\n1,{DATE} 10:00:00,20.0,010012345\n"
         + "".join(f"{i + 1},{DATE} 10:00:0{i},{20 + i}.0\n" for i in range(1, 6)), {"Celsius": RISING}, units={"Celsius": "degC"}),
    Case("Testo Comfort", "testo.csv", rows('"Datum";"Uhrzeit";"°C [Kanal 1]"\n', '"01.03.2026";"10:00:{s}";"{T},0"').encode("cp1252"),
         {"Kanal 1": RISING}, units={"Kanal 1": "degC"}),
    Case("Hioki 8430, durations", "hioki.csv", rows("HIOKI 8430,Ver 1.00\nTime,CH1-1[V],CH1-2[°C]\n", "0 00:00:{s}.0,{P},{T}"),
         {"CH1-1": POWER, "CH1-2": RISING}, units={"CH1-1": "V", "CH1-2": "degC"}),
    Case("Bio-Logic EC-Lab", "ec.mpt", rows("EC-Lab ASCII FILE\nNb header lines : 4\n\nmode\ttime/s\tEwe/V\tI/mA\n", "3\t{i}.0E+000\t{T}\t{P}"),
         {"Ewe": RISING, "I": POWER}, units={"Ewe": "V", "I": "mA"}),
    Case("Victron VRM", "vrm.csv", rows("timestamp,System [0],Battery [1]\ntimezone,PV power,Voltage\nEurope/Berlin (+01:00),W,V\n",
         DATE + " 10:00:{s},{P},{T}"), {"PV power": POWER, "Voltage": RISING}, units={"PV power": "W", "Voltage": "V"}),
    Case("DWD, an hour a row", "produkt_tu.txt", rows("STATIONS_ID;MESS_DATUM;QN_9;TT_TU;eor\n", "         44;202603010{i};    3;  {T}.0;eor"),
         {"TT_TU": RISING}, [3600.0 * i for i in range(6)]),
    Case("PicoLog 6", "picolog.csv", rows('"","TC08 Channel 1 Ave. (°C)","Power (W)"\n', DATE + "T10:00:{s}+01:00,{T}.0,{P}"),
         {"TC08 Channel 1 Ave.": RISING, "Power": POWER}),
    Case("PicoScope", "pico.csv", rows("Time,Channel A,Channel B\n(ms),(V),(mV)\n\n", "{k}.00000000,{T}.0,{P}"),
         {"Channel A": RISING, "Channel B": POWER}, [0, 0.5, 1, 1.5, 2, 2.5], {"Channel A": "V", "Channel B": "mV"}),
    Case("Graphtec GL", "graphtec.csv", rows("Vendor,GRAPHTEC\nSampling interval,500ms\n\nNumber,Date&Time,ms,CH1,Alarm\nNO.,Time,ms,degC,A1\n",
         DATE.replace("-", "/").join(["{i},", " 10:00:0{i},0,+  {T}.0,L"])), {"CH1": RISING}, units={"CH1": "degC"}),
    Case("Keysight InfiniiVision", "keysight.csv", rows("x-axis,1,2\nsecond,Volt,Volt\n", "+{i}.0000E+00,+{T}.0E+00,+{P}.0E+00"),
         {"1": RISING, "2": POWER}, units={"1": "V", "2": "V"}),
    Case("Rigol DS1000Z", "rigol.csv", rows("X,CH1,Start,Increment,\nSequence,Volt,-1.000000e+00,5.000000e-01\n", "{i},{T}.0e+00,"),
         {"CH1": RISING}, [-1, -0.5, 0, 0.5, 1, 1.5], {"CH1": "V"}),
    Case("Tektronix TDS", "tek.csv", "".join(
        f"{k},{x},,{i}.0,{20 + i}.0,\n" for i, (k, x) in enumerate([("Record Length", "6"), ("Sample Interval", "1.0"), ("Source", "CH1"),
        ("Vertical Units", "V"), ("Horizontal Units", "s"), ("", "")])), {"CH1": RISING}, units={"CH1": "V"}),
    Case("Tektronix MSO", "mso.csv", rows("Model,MSO54\n\nWaveform Type,ANALOG,,\nHorizontal Units,s,,\nSample Interval,0.1,,\nRecord Length,6,,\nVertical Units,A,V,\nLabel,,\nTIME,CH1,CH2\n",
         "{h},{T},{P}"), {"CH1": RISING, "CH2": POWER}, [0, 0.1, 0.2, 0.3, 0.4, 0.5], {"CH1": "A", "CH2": "V"}),
    Case("Siglent", "siglent.csv", rows("Record Length,Analog:6\nSample Interval,Analog:1.0E-01\nVertical Units,CH1:V,CH2:A\nHorizontal Units,s\nSource,CH1,CH2\nSecond,Volt,Ampere\n",
         "{h},{T},{P}"), {"CH1": RISING, "CH2": POWER}, [0, 0.1, 0.2, 0.3, 0.4, 0.5], {"CH1": "V", "CH2": "A"}),
    Case("Rigol MSO5000, values only", "mso5000.csv", rows("CH1V,CH2V,t0 = -0.5, tInc = 0.5,\n", "{T},{P},,"), {"CH1": RISING, "CH2": POWER},
         [-0.5, 0, 0.5, 1, 1.5, 2], {"CH1": "V"}),
    Case("Teledyne LeCroy", "lecroy.csv", rows("LECROYWR104Xi,18,Waveform\nSegments,1,SegmentSize,6\nSegment,TrigTime,TimeSinceSegment1\n"
         "#1,01-Mar-2026 10:00:00,0\nTime,Ampl\n", "{i},{T}.0"), {"Ampl": RISING}),
    Case("Fluke 289 FlukeView", "fluke.csv", rows("Reading,Sample,Start Time,Duration,Max Time,Max\n", "{i},{T}.0 °C,3/1/2026 10:00:{s} AM,0:00:01.0,3/1/2026 10:00:{s} AM,{T}.5 °C"),
         {"Sample": RISING}, units={"Sample": "degC"}),
    Case("Yokogawa DL, interval in the header", "yokogawa.csv", rows('"Model","DL850"\n"BlockNumber",1\n"HResolution",5.0e-01\n"HOffset",0.0\n"HUnit","s"\n"TraceName","T","P"\n"VUnit","C","W"\n',
         ",{T}.0,{P}.0"), {"T": RISING, "P": POWER}, [0, 0.5, 1, 1.5, 2, 2.5]),
    Case("Yokogawa GX, date and time apart", "gx.csv", rows("Device,GX20\n\nDate,Time,sec,CH0001,CH0002\n,,,°C,W\n", "2026/03/01,10:00:{s},000,{T}.0,{P}"),
         {"CH0001": RISING, "CH0002": POWER}),
    Case("Hioki, decimal comma", "hioki.csv", rows('"Date";"Time";"U1[V]";"P1[W]"\n', "2026/03/01;10:00:{s};{T},0E+0;{P},0E+0"),
         {"U1": RISING, "P1": POWER}, units={"U1": "V", "P1": "W"}),
    Case("dSPACE ControlDesk, .mat", "dspace.mat", _mat_dspace, {"T": RISING, "P": POWER}),
    Case("dSPACE, INCA, MDF 3", "mdf3.dat", _mdf("3.30"), {"T": RISING, "P": [5, np.nan, np.nan, 7, np.nan, np.nan]}, units={"T": "degC", "P": "mW"}),
    Case("CANape, MDF 4", "canape.mf4", _mdf("4.10"), {"T": RISING, "P": [5, np.nan, np.nan, 7, np.nan, np.nan]}, units={"T": "degC", "P": "mW"}),
    Case("MDF 4 with states of text", "state.mf4", _mdf_state, {"T": RISING, "P": POWER}, units={"T": "degC"}),
    Case("Saleae Logic, digital", "saleae.csv", "Time [s],Channel 0\n0.0,0\n0.5,1\n1.25,0\n", {"Channel 0": [0, 1, 0]}, [0, 0.5, 1.25]),
    Case("Siemens WinCC, data log", "wincc.csv", '"VarName";"TimeString";"VarValue";"Validity";"Time_ms"\n"$RT_OFF$";"01.03.2026 09:59:59";-1;2;46082416655,0926\n'
         + "".join(f'"T";"01.03.2026 10:00:0{i}";{20 + i},5;1;4608241666{6 + i},0\n' for i in (0, 1, 2)) + '"P";"01.03.2026 10:00:01";1;1;46082416667,0\n',
         {"T": [20.5, 21.5, 22.5], "P": [np.nan, 1, np.nan]}, [0, 1, 2]),
    Case("Siemens TIA, DataLog", "tia.csv", rows("Record,Date,UTC Time,T,P\n", "{i},3/1/2026,10:00:{s},{T}.0,{P}", end="//END,,,,\n"), {"T": RISING, "P": POWER}),
    Case("Beckhoff TwinCAT Scope", "scope.csv", rows("Name\tScope Project\nFile\tC:\\x.svdx\nStarttime of export\t01.03.2026 10:00:00\n\nName\tT\tName\tP\n"
         "SampleTime[ms]\t500\tSampleTime[ms]\t500\nUnit\t°C\tUnit\tW\n", "{k}\t{T}.0\t{k}\t{P}.0"), {"T": RISING, "P": POWER}, [0, 0.5, 1, 1.5, 2, 2.5]),
    Case("InfluxDB, annotated CSV", "influx.csv", rows("#group,false,false,false,true,false\n#datatype,string,long,dateTime:RFC3339,string,double\n#default,_result,,,,\n"
         ",result,table,_time,_field,_value\n", ",,0," + DATE + "T10:00:{s}Z,T,{T}") + rows("", ",,1," + DATE + "T10:00:{s}Z,P,{P}"), {"T": RISING, "P": POWER}),
    Case("InfluxDB, line protocol", "points.txt", rows("", "rig,place=block T={T}.5,P={P}i 177235920{i}000000000"), {"T": [x + 0.5 for x in RISING], "P": POWER}),
    Case("Home Assistant, history CSV", "history.csv", "entity_id,state,last_changed\n" + "".join(
        f"{e},{s},{_ISO.format(t)}\n" for (e, s), t in zip(_HA, _HA_TIMES, strict=True)),
        {"sensor.block": [20, np.nan, 22, np.nan], "switch.heater": [0, np.nan, np.nan, 1]}, [0, 1, 2, 3]),
    Case("Home Assistant, history of the API", "history.json", json.dumps([[{"entity_id": e, "state": s, "last_changed": _ISO.format(t), "attributes": {}}
         for (e, s), t in zip(_HA, _HA_TIMES, strict=True) if e == x] for x in ("sensor.block", "switch.heater")]),
        {"sensor.block": [20, np.nan, 22, np.nan], "switch.heater": [0, np.nan, np.nan, 1]}, [0, 1, 2, 3]),
    Case("Home Assistant, long-term statistics", "statistics.csv", rows("statistic_id,unit,start,mean,min,max\n", "sensor.block,°C," + DATE + " 10:00:{s},{T},0,99"),
         {"sensor.block": RISING}, units={"sensor.block": "degC"}),
    Case("Tasmota, Zigbee: JSON in JSON", "tele.jsonl", rows("", '{{"Time": "' + DATE + 'T10:00:{s}", "DS18B20": {{"Temperature": {T}}}, "TempUnit": "C"}}'),
         {"DS18B20_Temperature": RISING}),
    Case("Grafana, series joined by time", "grafana.csv", rows('"Time","Block","Heater"\n', '"' + DATE + ' 10:00:{s}","{T} °C","{P} W"'),
         {"Block": RISING, "Heater": POWER}, units={"Block": "degC", "Heater": "W"}),
    Case("Grafana, a series a row", "series.csv", rows('"Series";"Time";"Value"\n', '"T";"' + DATE + 'T10:00:{s}Z";{T}'), {"T": RISING}),
    Case("Prometheus, range query", "prom.json", json.dumps({"data": {"result": [{"metric": {"__name__": "T"}, "values": [[1772359200 + i, str(20 + i)] for i in range(6)]}]}}),
         {"T": RISING}),
    Case("Klipper, klippy.log", "klippy.log", rows("Start printer\n", _KLIPPER), {"heater_bed_temp": RISING, "heater_bed_pwm": [p / 10 for p in POWER]},
         units={"heater_bed_temp": "degC"}),
    Case("Moonraker, temperature store", "store.json", json.dumps({"result": {"extruder": {"temperatures": RISING, "targets": [0] * 6, "powers": POWER}}}),
         {"extruder_temperature": RISING, "extruder_power": POWER}, units={"extruder_temperature": "degC"}),
    Case("ThingSpeak, CSV", "feeds.csv", rows("created_at,entry_id,field1,field2\n", DATE + " 10:00:{s} UTC,{i},{T},{P}"), {"field1": RISING, "field2": POWER}),
    Case("ThingSpeak, JSON", "feeds.json", json.dumps({"channel": {"field1": "T"}, "feeds": [{"created_at": _ISO.format(i), "entry_id": i, "field1": str(20 + i)} for i in range(6)]}),
         {"T": RISING}),
    Case("Excel with a cover sheet", "cover.xlsx", _excel, {"T": RISING, "P": POWER}, units={"T": "degC"}),
    Case("Parquet with columns of every type", "mixed.parquet", _parquet, {"T": RISING, "P": POWER}),
    Case("Arduino Serial Plotter, milliseconds", "arduino.txt", rows("millis\tT\tP\n", "{k}\t{T}.0\t{P}"), {"T": RISING, "P": POWER}, [0, 0.5, 1, 1.5, 2, 2.5]),
    Case("Arduino plotter, labels", "plotter.txt", rows("", "time_ms:{k} T:{T}.0 P:{P}"), {"T": RISING, "P": POWER}, [0, 0.5, 1, 1.5, 2, 2.5]),
    Case("Arduino monitor, times before the lines", "monitor.txt", rows("09:59:59.500 -> T,P\n", "10:00:{s}.000 -> {T},{P}"), {"T": RISING, "P": POWER}),
    Case("Arduino monitor, without a header", "bare.txt", rows("", "10:00:{s}.000 -> {T};{P}"), {"column_2": RISING, "column_3": POWER}),
    Case("Campbell, array of parts of the date", "cr10x.dat", "year,doy,hhmm,T\n" + "".join(f"2026,60,{1000 + i},{20 + i}\n" for i in range(6)), {"T": RISING},
         [60.0 * i for i in range(6)]),
    Case("EnergyPlus", "eplusout.csv", "Date/Time,ROOM:Zone Mean Air Temperature [C](TimeStep)\n 03/01  23:50:00,20\n 03/01  24:00:00,21\n 03/02  00:10:00,22\n",
         {"ROOM:Zone Mean Air Temperature": [20, 21, 22]}, [0, 600, 1200], {"ROOM:Zone Mean Air Temperature": "degC"}),
    Case("EnergyPlus weather, EPW", "town.epw", rows("LOCATION,Town,-,NLD\nDATA PERIODS,1,1,Data\n", "1995,1,1,{i},60,?9,{T},{P}"),
         {"column_7": RISING, "column_8": POWER}, [3600.0 * i for i in range(6)]),
    Case("NREL MIDC", "midc.csv", rows(",Year,DOY,MST,T [deg C],P [W]\n", "0,2026,60,100{i},{T},{P}"),
         {"T": RISING, "P": POWER}, [60.0 * i for i in range(6)], {"T": "degC", "P": "W"}),
    Case("Haltech NSP", "haltech.csv", rows("%DataLog%\nSoftware : NSP\nChannel : T\nID : 1\nChannel : P\nID : 2\n", "10:00:{s}.500,{T},{P}"), {"T": RISING, "P": POWER}),
    Case("Rotronic", "rotronic.csv", rows("[#1],,,\nP = W,,,\n[#2],,,\nT = °C,,,\n[#H],,,\nDate,Time,P,T\n,,,\n[#D],,,\n", "24/01/2026,13:00:{s},{P},{T}"),
         {"T": RISING, "P": POWER}, units={"T": "degC", "P": "W"}),
    Case("GW Instek GDS", "gds.csv", rows("Memory Length,6,\nSource,CH1,\nVertical Units,V,\nHorizontal Units,S,\nSampling Period,1,\nTime, ,\nMode,Detail,\nWaveform Data,\n", "{i},{T},"),
         {"column_2": RISING}, units={"column_2": "V"}),
    Case("Neware, nested", "neware.csv", rows("Cycle ID,Cap(mAh)\n,Step ID,Step Name\n,,Record ID,T(oC),P(W),Realtime\n1,9.5\n,1,Rest\n", ",,{i},{T},{P}," + DATE + " 10:00:{s}"),
         {"Record ID": T6, "T": RISING, "P": POWER}, units={"T": "degC", "P": "W"}),
    Case("Keysight BenchLink", "bench.csv", rows('"Channel","Name","Function","Range"\n"101","","Temp (Type K)",""\n"Scan Control:"\n"Scan","Time","101 (C)"\n', "{i},3/14/2026 10:00:{s}:123,{T}"),
         {"101": RISING, "Scan": T6}, units={"101": "degC"}),
    Case("Sea-Bird, CNV", "cast.cnv", rows("* Sea-Bird SBE 9\n# name 0 = timeS: Time [seconds]\n# name 1 = T: Temperature [deg C]\n# name 2 = P: Pressure [bar]\n*END*\n", "   {i}   {T}   {P}"),
         {"T: Temperature": RISING, "P: Pressure": POWER}, units={"T: Temperature": "degC", "P: Pressure": "bar"}),
    Case("Origin, names, units, comments", "origin.txt", rows("Time\tT\tP\ns\tdegC\tW\nrun 1\tblock\theater\n", "{i}\t{T}\t{P}"), {"T": RISING, "P": POWER}, units={"T": "degC", "P": "W"}),
    Case("gzip of a CSV", "run.csv.gz", gzip.compress(rows("time [s],T,P\n", "{i},{T},{P}").encode()), {"T": RISING, "P": POWER}),
    Case("LabVIEW LVM, a header a segment", "segments.lvm", "LabVIEW Measurement\t\nMulti_Headings\tYes\n***End_of_Header***\t\n\t\n" + "\t\n".join(
            f"Channels\t1\nSamples\t3\nX0\t{k}\nDelta_X\t1\n***End_of_Header***\t\nX_Value\tT\tComment\n" + "".join(f"{i}\t{20 + i}\t\n" for i in range(k, k + 3)) for k in (0, 3)),
         {"T": RISING}),
    Case("Multimeter that changes its range", "dmm.csv", rows("No,Time,Value,Unit,Mode\n", "{i},10:00:{s},{T},VDC,AUTO", 5, "6,10:00:05,25000,mVDC,AUTO\n"), {"Value": RISING}, units={"Value": "V"}),
    Case("Keysight 34465A, overload", "dmm2.csv", rows("Sample,Time (s),Reading\n", "{i},{i}.0E+00,+{T}.0E+00", 5, "5,5.0,+9.90000000E+37\n"), {"Reading": [*RISING[:5], np.nan]}),
    Case("Graphtec GL, out of range", "over.csv", rows("Number,Date&Time,CH1,CH2\n", "{i}," + DATE + " 10:00:{s},+  {T}.0,+  1.5", 5, "6," + DATE + " 10:00:05,+++++++,-------\n"),
         {"CH1": [*RISING[:5], np.nan], "CH2": [1.5] * 5 + [np.nan]}),
    Case("PicoScope, over range", "infinite.csv", rows("Time,Channel A\n(ms),(V)\n\n", "{k},{T}", 5, "2500,-∞\n"), {"Channel A": [*RISING[:5], np.nan]}, t=[i / 2 for i in range(6)]),
    Case("Artisan, a roast", "roast.csv", rows("Date:01.03.2026\tUnit:C\tCHARGE:00:01\tTime:10:00\nTime1\tTime2\tET\tBT\tEvent\n", "00:{s}\t\t1{T}\t{T}\t"), {"BT": RISING}),
    Case("Windows in Chinese", "halves.csv", rows("时间,T\n", "2026/3/1 上午11:59:5{i},{T}", 6, "2026/3/1 下午12:00:00,30\n"), {"T": [*RISING, 30]}, t=[*T6, 10]),
    Case("a logger that lost power", "power.csv", rows("Time [s],T\n", "{i}.0,{T}.0").encode() + bytes(700) + b"\n6.0,26.0\n7.0,2", {"T": [*RISING, 26]}, t=[*T6, 6]),
    Case("two files joined, each with a mark of byte order", "joined.csv", 2 * b"\xef\xbb\xbfTime,T\n0,20\n1,21\n2,22\n", {"T": RISING[:3]}, t=T6[:3], how={"run": 2}),
    Case("Beckhoff TwinCAT Scope, two rates", "rates.csv", "Name\tT\tName\tP\nSampleTime[ms]\t1000\tSampleTime[ms]\t500\nUnit\t(None)\tUnit\tW\n"
         + "".join(f"{x}\t{500 * k}\t{k}\n" for k, x in enumerate(["0\t20", "1000\t21", "2000\t22", "EOF\tEOF", "EOF\tEOF"])),
         {"T": [20, np.nan, 21, np.nan, 22], "P": [0, 1, 2, 3, 4]}, [0, 0.5, 1, 1.5, 2], {"P": "W"}),
    Case("Rockwell FactoryTalk, a trend", "trend.csv", rows("Trend Name:,Run\nSample Period:,1000 ms\n\nHeader:,Date,Time,T,P\n", "Data,03/14/2026,10:00:{s};500,{T}.0,{P}"),
         {"T": RISING, "P": POWER}),
    Case("Ignition, a dataset", "dataset.csv", rows('"#NAMES"\n"t_stamp","T","P"\n"#TYPES"\n"date","D","D"\n"#ROWS","6"\n', '"' + DATE + ' 10:00:{s}","{T}","{P}"'),
         {"T": RISING, "P": POWER}),
    Case("InfluxDB, series of one measurement by a tag", "tags.csv", rows("name,time,host,value\n", "temp,177235920{i}000000000,a,{T}")
         + rows("", "temp,177235920{i}000000000,b,{P}"), {"a": RISING, "b": POWER}),
    Case("Windows performance monitor", "perfmon.csv", rows('"(PDH-CSV 4.0) (UTC)(0)","\\\\PC\\Fan","\\\\PC\\Load"\n', '"03/14/2026 10:00:{s}.123","{T}"," "'),
         {"\\\\PC\\Fan": RISING}),
    Case("PX4, ulog2csv", "sensor_baro_0.csv", rows("timestamp,timestamp_sample,temperature\n", "{i}020000,{i}019400,{T}.5"),
         {"temperature": [x + 0.5 for x in RISING]}, [0.02, 1.02, 2.02, 3.02, 4.02, 5.02]),
    Case("logfmt", "run.log", rows("", "ts=" + DATE + "T10:00:{s}Z level=info T={T} P={P}"), {"T": RISING, "P": POWER}),
    Case("a program's log of a date and pairs", "pairs.log", rows("", DATE + "T10:00:{s}Z T={T} P={P}"), {"T": RISING, "P": POWER}),
    Case("a unit behind each value, without a name", "units.csv", rows("Time (s),T,,P,\n", "{i},{T},°C,{P},W"), {"T": RISING, "P": POWER}, units={"T": "degC", "P": "W"}),
    Case("JSON lines", "run.jsonl", rows("", '{{"time": "' + DATE + 'T10:00:{s}Z", "T": {T}, "P": {P}}}'), {"T": RISING, "P": POWER}),
)  # fmt: skip


def differences(case: Case, table: Table) -> list[str]:
    """Return what in a table is not as the case states; columns beside them may be there."""
    found = []
    t = table.t - (table.t[0] if table.meta.get("start") or "Stats" in str(case.content) else 0.0)
    if len(t) != len(case.t) or not np.allclose(t, case.t, atol=1e-6):
        found.append(f"t {t.tolist()} instead of {case.t}")
    for name, values in case.columns.items():
        have = table.columns.get(name)
        if have is None or len(have) != len(values) or not np.allclose(have, values, equal_nan=True):
            found.append(f"{name} {None if have is None else have.tolist()} instead of {values}")
    found += [
        f"{n} in {table.units.get(n)} instead of {u}"
        for n, u in case.units.items()
        if table.units.get(n) != u
    ]
    return found


def line(case: Case, folder: Path) -> str:
    """Read a case and return its row of the page. Raises AssertionError for a wrong answer."""
    trace: list[str] = []
    table = read_recording(case.written(folder), **case.how, trace=trace)
    if wrong := differences(case, table):
        raise AssertionError(f"{case.logger}: {'; '.join(wrong)}")
    kind = next(x.partition(": ")[2] for x in trace if x.startswith("format: "))
    read_as = next(
        (x.partition("text, ")[2].partition(", data")[0] for x in trace if x.startswith("read as: ")), kind
    )
    times = dict.fromkeys(x.partition(": ")[2].split(":")[0] for x in trace if x.startswith("time: "))
    units = ", ".join(f"{n} {u}" for n, u in table.units.items()) or "none stated"
    notes = "; ".join(
        n.partition(" (another:")[0] for n in table.notes if not n.startswith("separator")
    ).replace("|", "\\|")
    return f"| {case.logger} | {read_as.replace('|', 'bar')} | {' and '.join(times)} | {units} | {notes.replace(str(folder) + '/', '')} |"


def page() -> str:
    """Return the page: a row for each logger."""
    with tempfile.TemporaryDirectory() as folder:
        body = "\n".join(line(case, Path(folder)) for case in CASES)
    return (
        "# Loggers and programs whose files are read\n\n"
        "Each row is a small file of our own, written after the manual of the logger; `make loggers` reads all of them, compares\n"
        "every number, and prints this table. How a file of yours is read: `thermoctl recordings import --explain FILE`.\n\n"
        f"| logger | read as | time from | units | notes |\n|---|---|---|---|---|\n{body}\n"
    )


if __name__ == "__main__":
    text = page()
    if "--write" in sys.argv:
        PAGE.write_text(text)
    print(text if "--write" not in sys.argv else f"{PAGE}: {len(CASES)} loggers")
