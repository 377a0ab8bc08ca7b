"""JSON of data frames, databases and panels is read to the numbers, times and units that it holds."""

import json

import numpy as np
import pandas as pd
import pytest

from thermoctl.recording.foreign.logger import read_recording

T = [20.0, 21.0, 22.0, 23.0]
P = [0.0, 0.0, 1.5, 1.5]
SECONDS = [0.0, 0.5, 1.0, 1.5]
START = 1_772_359_200_000
DATES = pd.date_range("2026-03-01 10:00:00", periods=4, freq="500ms")
STAMPS = [START + round(1000 * t) for t in SECONDS]


def read(folder, content):
    path = folder / "run.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_recording(path)


def check(table, units=None):
    assert {n: c.tolist() for n, c in table.columns.items()} == {"T": T, "P": P}
    assert np.allclose(table.t - table.t[0], SECONDS, atol=1e-6) and table.units == (units or {})


@pytest.mark.parametrize("orient", ["columns", "index", "split", "table"])
@pytest.mark.parametrize("index", [DATES, pd.Index(SECONDS)], ids=["dates", "seconds"])
def test_the_index_of_a_data_frame_is_its_time(tmp_path, orient, index):
    frame = pd.DataFrame({"T": T, "P": P}, index=index)
    check(read(tmp_path, frame.to_json(orient=orient, date_format="iso")))


@pytest.mark.parametrize("orient", ["columns", "index", "split", "table", "records"])
def test_an_index_that_counts_gives_way_to_a_column_of_times(tmp_path, orient):
    frame = pd.DataFrame({"time": DATES, "T": T, "P": P})
    check(read(tmp_path, frame.to_json(orient=orient, date_format="iso")))


def test_a_series_and_a_frame_with_rows_and_columns_exchanged(tmp_path):
    series = read(tmp_path, pd.Series(T, index=DATES).to_json(date_format="iso"))
    assert series.columns["value"].tolist() == T and series.t.tolist() == SECONDS
    check(read(tmp_path, pd.DataFrame({"T": T, "P": P}, index=SECONDS).T.to_json()))


def frame_of_grafana(name, unit, values, sensor):
    field = {"name": "Value", "type": "number", "labels": {"sensor": sensor}, "config": {"unit": unit}}
    if name:
        field["config"]["displayName"] = name
    schema = {"refId": "A", "fields": [{"name": "Time", "type": "time", "config": {"interval": 500}}, field]}
    return {"schema": schema, "data": {"values": [STAMPS, values]}}


@pytest.mark.parametrize("names", [("T", "P"), (None, None)], ids=["displayed names", "labels"])
def test_data_frames_of_grafana(tmp_path, names):
    frames = [frame_of_grafana(names[0], "celsius", T, "T"), frame_of_grafana(names[1], "mwatt", P, "P")]
    units = {"T": "degC", "P": "mW"}
    check(read(tmp_path, frames), units)
    results = {k: {"status": 200, "frames": [f]} for k, f in zip("AB", frames, strict=True)}
    check(read(tmp_path, {"results": results}), units)


def test_a_panel_of_grafana(tmp_path):
    columns = {"Time": (STAMPS, ""), "T": (T, "celsius"), "P": (P, "watt")}
    fields = [{"name": n, "config": {"unit": u}, "values": v} for n, (v, u) in columns.items()]
    check(read(tmp_path, {"state": "Done", "series": [{"fields": fields}]}), {"T": "degC", "P": "W"})
    pairs = ({"target": n, "datapoints": list(zip(v, STAMPS, strict=True))} for n, v in (("T", T), ("P", P)))
    check(read(tmp_path, list(pairs)))


def test_series_of_influxdb_that_differ_by_a_tag(tmp_path):
    series = [
        {
            "name": "rig",
            "tags": {"s": n},
            "columns": ["time", "value"],
            "values": list(zip(STAMPS, v, strict=True)),
        }
        for n, v in (("T", T), ("P", P))
    ]
    check(read(tmp_path, {"results": [{"statement_id": 0, "series": series}]}))


def test_names_beside_rows(tmp_path):
    rows = list(zip(STAMPS, T, P, strict=True))
    check(read(tmp_path, {"header": ["time", "T", "P"], "rows": rows}))


def test_home_assistant_states_a_unit_once_for_an_entity(tmp_path):
    def history(name, unit, values):
        first = {"entity_id": name, "attributes": {"unit_of_measurement": unit}}
        stamps = (f"{d.isoformat()}+00:00" for d in DATES)
        changes = [{"state": str(v), "last_changed": d} for v, d in zip(values, stamps, strict=True)]
        return [first | changes[0], *changes[1:]]

    units = {"T": "degC", "P": "W"}
    check(read(tmp_path, [history("T", "°C", T), history("P", "W", P)]), units)
    socket = {
        n: [
            {"s": str(v), "a": {"unit_of_measurement": u} if k == 0 else {}, "lu": STAMPS[k] / 1000}
            for k, v in enumerate(values)
        ]
        for n, values, u in (("T", T, "°C"), ("P", P, "W"))
    }
    check(read(tmp_path, socket), units)
