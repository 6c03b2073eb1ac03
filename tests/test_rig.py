"""The rig file: shipped rigs, exact round trips, one line per fault, overrides, conversion to SI."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tbmfg.errors import RigError
from tbmfg.rig import KINDS, Rig, dump_rig, load_rig, override, parse_rig, shipped

MINIMAL = "sensors: {imu: {topic: /imu}}"


def fault(text: str) -> str:
    with pytest.raises(RigError) as caught:
        parse_rig(text, "rig.yaml")
    return str(caught.value)


def rig_with(sensors: str, rest: str = "") -> str:
    return f"sensors:\n  imu: {{topic: /imu}}\n{sensors}\n{rest}"


# ---- what is shipped, and round trips ----


@pytest.mark.parametrize("name", shipped())
def test_shipped_rig_loads_as_itself_and_round_trips(name):
    rig = load_rig(name)
    assert rig.name == name
    assert parse_rig(dump_rig(rig), "dump") == rig


def test_shipped_rigs_are_there():
    assert {"euroc-leica", "tbm"} <= set(shipped())


def test_tbm_arm_is_the_papers_in_forward_left_up():
    forward_right_down = np.array([0.0918, -0.8221, -0.384])
    assert_allclose(load_rig("tbm").sensors["prism"].arm, forward_right_down * [1, -1, -1])


def test_everything_but_topics_has_a_default():
    sensors = "\n".join(f"  {kind}: {{topic: /{kind}}}" for kind in KINDS if kind != "imu")
    rig = parse_rig(rig_with(sensors), "rig.yaml")
    assert set(rig.sensors) == set(KINDS)
    assert all(type(rig.sensors[kind]) is KINDS[kind] for kind in KINDS)
    assert parse_rig(dump_rig(rig), "dump") == rig


@given(
    value=st.floats(min_value=1e-300, max_value=1e300),
    topic=st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1),
)
def test_round_trip_is_exact_for_any_number_and_any_topic(value, topic):
    rig = Rig.model_validate({"lag_s": value, "sensors": {"imu": {"topic": topic}}})
    assert parse_rig(dump_rig(rig), "dump") == rig


@pytest.mark.filterwarnings("error")
def test_whole_numbers_round_trip_where_a_word_may_stand():
    text = "sensors: {imu: {topic: /imu, noise_factor: 2}}\nsurvey: [{at: 3, position_m: [1, 2, 3], sigma_m: 1}]"
    rig = parse_rig(text, "rig.yaml")
    assert parse_rig(dump_rig(rig), "rig.yaml") == rig
    assert (rig.imu.noise_factor, rig.survey[0].at) == (2.0, 3.0)


def test_rig_pickles_and_is_frozen():
    rig = load_rig("tbm")
    assert pickle.loads(pickle.dumps(rig)) == rig
    with pytest.raises(ValueError, match="frozen"):
        rig.lag_s = 3


def test_file_is_read_with_its_name_in_messages(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(MINIMAL)
    assert load_rig(path).imu.topic == "/imu"
    path.write_text("lags: 3\n" + MINIMAL)
    with pytest.raises(RigError, match=r"mine\.yaml:1: lags: unknown key; did you mean lag_s\?"):
        load_rig(str(path))


def test_unknown_name_is_refused_with_what_there_is(tmp_path):
    with pytest.raises(RigError, match=r"euroc: neither a file nor a shipped rig; did you mean euroc-leica\?"):
        load_rig("euroc")
    with pytest.raises(RigError, match="cannot be read"):
        load_rig(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigError, match=r"binary\.yaml: cannot be read: not UTF-8 text"):
        load_rig(tmp_path / "binary.yaml")


# ---- refusals ----


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "rig.yaml:1: the file: should be a mapping, got null"),
        ("lag_s: 3", "rig.yaml:1: sensors: is required"),
        ("sensors: {}", "rig.yaml:1: sensors: should hold one IMU, called imu"),
        ("sensors: {gnss: {topic: /fix}}", "rig.yaml:1: sensors: should hold one IMU, called imu, not gnss"),
        ("sensors: {imu: {}}", "rig.yaml:1: sensors.imu.topic: is required"),
        ("sensors: {imu: 3}", "rig.yaml:1: sensors.imu: should be a mapping, got 3"),
        ("sensors: {imu: {topic: 3}}", "rig.yaml:1: sensors.imu.topic: should be a valid string, got 3"),
        ("3: 4\n" + MINIMAL, "rig.yaml:1: the file: a key should be a name, got 3"),
        (MINIMAL + "\nlag_s: '3'", 'rig.yaml:2: lag_s: should be a valid number, got "3"'),
        (MINIMAL + "\nlag_s: true", "rig.yaml:2: lag_s: should be a valid number, got true"),
        (MINIMAL + "\nlag_s: .nan", "rig.yaml:2: lag_s: should be a finite number, got .nan"),
        (MINIMAL + "\nlag_s: 1e999", "rig.yaml:2: lag_s: should be a finite number, got 1e999"),
        (MINIMAL + "\nlag_s: 0", "rig.yaml:2: lag_s: should be greater than 0, got 0"),
        (MINIMAL + "\nlag_s: 3\nlag_s: 4", "rig.yaml:3: lag_s: is given twice, first in line 2"),
        (
            MINIMAL + "\norigin:\n  latitud_deg: 3",
            "rig.yaml:3: origin.latitud_deg: unknown key; did you mean latitude_deg or longitude_deg?",
        ),
        (
            MINIMAL + "\norigin: {latitude_deg: 91}",
            "rig.yaml:2: origin.latitude_deg: should be less than or equal to 90, got 91",
        ),
        (
            MINIMAL + "\ninitial: {roll_deg: 1}",
            "rig.yaml:2: initial: roll_deg and pitch_deg should be given together or not at all",
        ),
        (MINIMAL + "\nmotion: {radius_m: 1}", "rig.yaml:2: motion.speed_mps: is required"),
        (
            MINIMAL + "\nmotion: {radius_m: 1, speed_mps: 1, speed: 1}",
            "rig.yaml:2: motion.speed: unknown key; did you mean speed_mps?",
        ),
        (
            MINIMAL + "\nsurvey:\n- {at: noon, position_m: [0, 0, 0], sigma_m: 1}",
            'rig.yaml:3: survey.0.at: should be start, end or seconds from the first IMU sample, got "noon"',
        ),
        (MINIMAL + "\nestimators: {batch: 3}", "rig.yaml:2: estimators.batch: should be a mapping, got 3"),
        (
            rig_with("  prism: {topic: /p, arm_sd_m: -1}"),
            "rig.yaml:3: sensors.prism.arm_sd_m: should be greater than or equal to 0, got -1",
        ),
        (
            rig_with("  prism: {topic: /p, arm_m: [1, 2]}"),
            "rig.yaml:3: sensors.prism.arm_m: should be three numbers [x, y, z], got [1, 2]",
        ),
        (
            rig_with("  prism: {topic: /p, sigma_mmm: 1}"),
            "rig.yaml:3: sensors.prism.sigma_mmm: unknown key; did you mean sigma_mm or sigma_ppm?",
        ),
        (rig_with("  prsm: {topic: /p}"), "rig.yaml:3: sensors.prsm: no such kind of sensor; did you mean prism?"),
        (
            rig_with("  prism.2: {topic: /p}"),
            "rig.yaml:3: sensors.prism.2: no such kind of sensor; did you mean prism?",
        ),
        (rig_with("  prism: {topic: /imu}"), "rig.yaml:3: sensors.prism.topic: /imu is already the topic of imu"),
        (
            "sensors: {imu: {topic: /imu, noise_factor: yes}}",
            'rig.yaml:1: sensors.imu.noise_factor: should be auto or a number greater than 0, got "yes"',
        ),
        (
            "sensors: {imu: {topic: /imu, T_bi: {xyz: [0, 0, 0]}}}",
            "rig.yaml:1: sensors.imu.T_bi.xyz: unknown key; did you mean xyz_m?",
        ),
        (
            "sensors: {imu: {topic: /imu, T_bi: {xyz_m: [0, 0, 1]}}}",
            "rig.yaml:1: sensors.imu.T_bi.xyz_m: should be zero, b has its origin at the IMU; "
            "move the other sensors' arms instead",
        ),
        ("a: [1", "rig.yaml:1: not valid YAML: expected ',' or ']', but got '<stream end>'"),
        ("a: &x 1\nb: *x", "rig.yaml:2: not valid YAML: aliases are not read"),
        ("a: \x00", "rig.yaml: not valid YAML: special characters are not allowed"),
        ("[" * 5000, "rig.yaml: nested too deeply"),
    ],
)
def test_refusal_is_one_line_with_place_key_reason_and_value(text, message):
    assert fault(text) == message


def test_every_fault_has_its_line_in_the_order_of_the_file():
    text = "lag_s: x\nsensors:\n  imu: {topic: /imu}\n  prism: {topic: /p, loss: hubert}\n  odometer: {}\nlags: 3\n"
    assert fault(text).splitlines() == [
        'rig.yaml:1: lag_s: should be a valid number, got "x"',
        "rig.yaml:4: sensors.prism.loss: should be 'none', 'huber', 'cauchy' or 'gnc', got \"hubert\"",
        "rig.yaml:5: sensors.odometer.topic: is required",
        "rig.yaml:6: lags: unknown key; did you mean lag_s?",
    ]


def test_scalars_are_those_of_yaml_1_2():
    assert parse_rig("lag_s: 1e1\n" + MINIMAL, "rig.yaml").lag_s == 10
    assert fault("lag_s: 1:30\n" + MINIMAL) == 'rig.yaml:1: lag_s: should be a valid number, got "1:30"'
    assert parse_rig("name: on\n" + MINIMAL, "rig.yaml").name == "on"


@given(st.text())
def test_any_text_that_is_no_rig_is_a_rig_error(text):
    with pytest.raises(RigError, match=r"rig\.yaml"):  # no text this short names a topic for an IMU
        parse_rig(text, "rig.yaml")


# ---- overrides ----


def test_override_replaces_values_and_leaves_the_rest():
    rig = load_rig("tbm")
    changed = override(
        rig,
        [
            "sensors.prism.sigma_mm=2",
            "sensors.prism.arm_m.2=0.4",
            "truth.topic=/other",
            "motion={radius_m: 1, speed_mps: 1e-1}",
            "estimators.shearer-afkf.beta=printed",
            "origin.latitude_deg=null",
        ],
    )
    assert changed.sensors["prism"].sigma_mm == 2
    assert changed.sensors["prism"].arm_m == (0.0918, 0.8221, 0.4)
    assert changed.truth.topic == "/other"
    assert changed.motion.speed_mps == 0.1
    assert changed.estimators == {"shearer-afkf": {"beta": "printed"}}
    assert changed.origin.latitude_deg is None
    assert changed.imu == rig.imu
    assert override(rig, []) == rig


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("sensors.prism.sigm_mm=2", "sensors.prism.sigm_mm: unknown key; did you mean sigma_mm or sigma_ppm?"),
        ("sensors.prim.sigma_mm=2", "sensors.prim: no such key; did you mean prism?"),
        ("sensors.prism.sigma_mm=-2", "sensors.prism.sigma_mm: should be greater than 0, got -2"),
        ("sensors.prism.sigma_mm=two", 'sensors.prism.sigma_mm: should be a valid number, got "two"'),
        ("sensors.prism.arm_m.3=2", "sensors.prism.arm_m has no item '3' (items 0 to 2)"),
        ("lag_s.x=2", "lag_s is a value, not a mapping"),
        ("lag_s", "should read key.path=value"),
        (".lag_s=3", "should read key.path=value"),
        ("survey=[{at: end, position_m: [0, 0, 0]}]", "survey.0.sigma_m: is required"),
    ],
)
def test_override_refuses_with_the_assignment_and_a_near_match(assignment, message):
    with pytest.raises(RigError) as caught:
        override(load_rig("tbm"), [assignment])
    assert str(caught.value) == f"--set {assignment}: {message}"


# ---- SI ----


def test_units_become_si():
    rig = parse_rig(
        rig_with(
            """\
  prism-left: {topic: /p, sigma_mm: 2, sigma_ppm: 1, station_m: [0, 0, 100], arm_sd_m: null}
  magnetometer: {topic: /m, declination_deg: 180, hard_iron_ut: [1, 2, 3], rpy_deg: [0, 0, 90]}
""",
            "origin: {latitude_deg: 90, x_axis_azimuth_deg: 180}\ninitial: {yaw_deg: -90}",
        ).replace("{topic: /imu}", "{topic: /imu, gyro_density_dps_rthz: 180, acc_density_ug_rthz: 1}"),
        "rig.yaml",
    )
    assert rig.imu.gyro_density == pytest.approx(np.pi)
    assert rig.imu.acc_density == pytest.approx(9.80665e-6)
    assert rig.imu.acc_bias_sd == 0.2
    assert_allclose(rig.imu.T_bi.R, np.eye(3))
    prism = rig.of_kind("prism")["prism-left"]
    assert prism.arm_sd == 0
    # 2 mm, and 1 mm per km: the second point lies 1 km from the station
    assert_allclose(prism.sigma_at([[0, 0, 100], [600, 800, 100]]), [0.002, 0.003])
    magnetometer = rig.sensors["magnetometer"]
    assert magnetometer.declination == pytest.approx(np.pi)
    assert_allclose(magnetometer.hard_iron, [1e-6, 2e-6, 3e-6])
    assert_allclose(magnetometer.R_bm @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    assert rig.initial.yaw == pytest.approx(-np.pi / 2)
    assert rig.initial.roll is None
    # at the pole the Earth turns about the vertical
    assert_allclose(rig.origin.rate_n, [0, 0, 7.292115e-5], atol=1e-20)
    assert rig.origin.gravity == pytest.approx(9.8321849, abs=1e-6)


def test_without_latitude_there_is_no_earth_rate_and_it_is_said():
    rig = parse_rig(MINIMAL, "rig.yaml")
    assert_allclose(rig.origin.rate_n, 0)
    assert rig.origin.gravity == 9.80665
    assert rig.assumptions() == ["assumed origin.latitude_deg: not given: no Earth rate, gravity 9.80665 m/s^2"]
    assert load_rig("tbm").assumptions() == []


def test_yaw_without_its_sd_has_no_weight_and_it_is_said():
    rig = override(load_rig("tbm"), ["initial.yaw_deg=12"])
    assert rig.assumptions() == ["assumed initial.yaw_deg: 12 counts for nothing, as yaw_sd_deg is 180"]


def test_every_field_is_described():
    """The rig reference is made from the model."""

    def nodes(model):
        yield model
        for field in model.model_fields.values():
            for part in (field.annotation, *getattr(field.annotation, "__args__", ())):
                if isinstance(part, type) and hasattr(part, "model_fields"):
                    yield from nodes(part)

    for top in (Rig, *KINDS.values()):
        for model in nodes(top):
            assert model.__doc__
            undescribed = [name for name, field in model.model_fields.items() if not field.description]
            assert undescribed == [], model.__name__


def test_switches_of_an_estimator_are_checked_when_the_rig_is_used():
    from tbmfg.estimators import check_switches

    rig = parse_rig(MINIMAL, "rig.yaml")
    check_switches(rig)
    with pytest.raises(RigError, match=r"estimators\.bacth: no such estimator; did you mean batch\?"):
        check_switches(override(rig, ["estimators.bacth.speed=1"]))
    with pytest.raises(RigError, match=r"estimators\.batch\.speed: unknown key"):
        check_switches(override(rig, ["estimators.batch.speed=1"]))
