"""The rig: one machine's sensors, mountings, noise and priors, read from YAML.

The fields are what a person writes, with the unit in the name (``sigma_mm``). Beside each stands a
property without the unit (``sigma``) that gives the same quantity in SI and radians, triples as
(3,) arrays. Conversion happens here and nowhere else.

A problem with a rig is a :class:`~tbmfg.errors.RigError` of one line per fault: file and line, key, reason.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from importlib import resources
from inspect import isclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, Field, SerializeAsAny, ValidationError, field_validator, model_validator

from tbmfg import earth, yamltext
from tbmfg.errors import RigError
from tbmfg.fields import (
    DEG,
    MICRO_G,
    MICRO_TESLA,
    MM,
    PPM,
    STANDARD_GRAVITY,
    ZERO,
    CalibrationSd,
    Flag,
    Loss,
    Moment,
    Node,
    NoiseFactor,
    NotNegative,
    Number,
    Positive,
    Text,
    Triple,
    explain,
    fault,
    near,
    or_raise,
    si,
)
from tbmfg.registry import Registry
from tbmfg.timeseries import Floats
from tbmfg.yamltext import KeyPath, dotted

# ---- where and how the machine starts ----


class Origin(Node):
    """Where the navigation frame lies on Earth and how it is turned."""

    latitude_deg: Annotated[Number, Field(ge=-90, le=90)] | None = Field(
        None, description="Geodetic latitude; null: no Earth rate is modelled and gravity is the standard one."
    )
    longitude_deg: Annotated[Number, Field(ge=-180, le=180)] | None = Field(
        None, description="Where n touches the Earth, for gnss; null: at the first fix of the log."
    )
    height_m: Number = Field(0.0, description="Height above the ellipsoid; 1 km changes gravity by 0.03 %.")
    x_axis_azimuth_deg: Number = Field(
        90.0, description="Direction of n's x axis, clockwise from true north; 90: x east, y north."
    )

    latitude = si("latitude_deg", DEG)
    longitude = si("longitude_deg", DEG)
    height = si("height_m")
    x_axis_azimuth = si("x_axis_azimuth_deg", DEG)

    @property
    def llh(self) -> Floats | None:
        """Latitude and longitude [rad] and height [m] of n's origin, (3,); None where n lies at the first fix."""
        if self.latitude is None or self.longitude is None:
            return None
        return np.array([self.latitude, self.longitude, self.height])

    @property
    def gravity(self) -> float:
        """Gravity [m/s^2], along minus z of n."""
        return STANDARD_GRAVITY if self.latitude is None else earth.gravity(self.latitude, self.height)

    @property
    def rate_n(self) -> Floats:
        """Earth rate in n [rad/s], (3,); zero where the latitude is not given."""
        return np.zeros(3) if self.latitude is None else earth.rate_n(self.latitude, self.x_axis_azimuth)


class Initial(Node):
    """Prior of the first state. A null value is found from the log; the sd is that of the prior either way."""

    yaw_deg: Number | None = Field(None, description="Heading of the body's x axis, counter-clockwise from n's x axis.")
    yaw_sd_deg: Positive = Field(180.0, description="How well yaw_deg is known; 180: not at all.")
    roll_deg: Number | None = Field(None, description="Rotation about x; null: levelled by the accelerometers.")
    pitch_deg: Number | None = Field(None, description="Rotation about y; null: levelled by the accelerometers.")
    tilt_sd_deg: Positive = Field(5.0, description="Of roll and pitch; 5 covers levelling on a moving machine.")
    position_m: Triple | None = Field(None, description="Position of b in n; null: from the first position fixes.")
    position_sd_m: Positive = Field(1.0, description="Per axis.")
    velocity_mps: Triple | None = Field(None, description="Velocity in n; null: standing.")
    velocity_sd_mps: Positive = Field(0.5, description="Per axis; 0.5 covers a crawling machine.")

    yaw = si("yaw_deg", DEG)
    yaw_sd = si("yaw_sd_deg", DEG)
    roll = si("roll_deg", DEG)
    pitch = si("pitch_deg", DEG)
    tilt_sd = si("tilt_sd_deg", DEG)
    position = si("position_m")
    position_sd = si("position_sd_m")
    velocity = si("velocity_mps")
    velocity_sd = si("velocity_sd_mps")


class Keyframes(Node):
    """When the estimators hold a state."""

    max_rate_hz: Positive = Field(25.0, description="Denser position fixes are averaged to this rate.")
    max_gap_s: Positive = Field(1.0, description="Longest time between keyframes; gaps are filled.")

    max_rate = si("max_rate_hz")
    max_gap = si("max_gap_s")


class Mounting(Node):
    """A sensor's pose in b: R = Rz(yaw) Ry(pitch) Rx(roll) takes its axes to b."""

    xyz_m: Triple = Field(ZERO, description="Origin of the sensor in b.")
    rpy_deg: Triple = Field(ZERO, description="Roll, pitch, yaw.")

    xyz = si("xyz_m")

    @property
    def R(self) -> Floats:
        """Rotation from the sensor's axes to b, (3, 3)."""
        return _rotation(self.rpy_deg)


def _rotation(rpy_deg: tuple[float, float, float]) -> Floats:
    from tbmfg.geometry import rotation_from_rpy  # brings scipy, which only reading a rig does not need

    return rotation_from_rpy(np.array(rpy_deg) * DEG)


# ---- sensors ----


class Sensor(Node):
    """What every sensor has: the topic it is recorded under."""

    topic: Text = Field(description="Topic in the log.")


class Enhancement(Node):
    """Inertial enhancement against vibration, for every estimator alike; an online one lags by a window then."""

    emd_threshold: Literal["noise", "kept", "off"] = Field(
        "noise",
        description="Modes that are thresholded; kept: as printed, which deletes motion; off: no decomposition.",
    )
    window_s: Positive = Field(4.0, description="Of the decomposition; windows overlap by half.")
    give_back: Flag = Field(
        True, description="What the modes take away of slow rates is given back; false: as printed."
    )
    alpha_bar: Annotated[Number, Field(ge=0, le=1)] = Field(
        0.001, description="Gain of the tilt by gravity per sample of 475 Hz; 1: as printed; 0: off."
    )

    window = si("window_s")


class Imu(Sensor):
    """Inertial unit; required. Defaults describe an industrial MEMS unit on a machine."""

    stamp: Literal["start", "centre", "end"] = Field(
        "end", description="Where in its sampling period a sample is stamped; most drivers stamp on arrival."
    )
    gyro_unit: Literal["rad/s", "deg/s"] = Field("rad/s", description="Unit of the messages; ROS has rad/s.")
    acc_unit: Literal["m/s^2", "g"] = Field("m/s^2", description="Unit of the messages; ROS has m/s^2.")
    T_bi: Mounting = Field(Mounting(), description="Turns IMU axes into b.")
    gyro_density_dps_rthz: Positive = Field(0.01, description="White noise, deg/s/sqrt(Hz).")
    acc_density_ug_rthz: Positive = Field(200.0, description="White noise, micro-g/sqrt(Hz).")
    gyro_walk: Positive = Field(2e-5, description="Random walk of the bias, rad/s/sqrt(s).")
    acc_walk: Positive = Field(1e-3, description="Random walk of the bias, m/s^2/sqrt(s).")
    gyro_bias_sd_dps: Positive = Field(1.0, description="Of the bias at the start, deg/s.")
    acc_bias_sd_mps2: Positive = Field(0.2, description="Of the bias at the start, m/s^2; 0.2 is 20 mg.")
    noise_factor: NoiseFactor = Field(
        1.0, description="Multiplies both densities; auto: found from the log (vibration makes data sheets optimistic)."
    )
    enhancement: Enhancement | None = Field(
        None,
        description="{emd_threshold: noise, kept or off; window_s: 4; alpha_bar: 0.001}: vibration taken out by "
        "empirical mode decomposition, tilt held by gravity; {}: with these values; null: not at all.",
    )

    gyro_density = si("gyro_density_dps_rthz", DEG)
    acc_density = si("acc_density_ug_rthz", MICRO_G)
    gyro_bias_sd = si("gyro_bias_sd_dps", DEG)
    acc_bias_sd = si("acc_bias_sd_mps2")

    @property
    def gyro_scale(self) -> float:
        """What turns the messages' angular rates into rad/s."""
        return DEG if self.gyro_unit == "deg/s" else 1.0

    @property
    def acc_scale(self) -> float:
        """What turns the messages' specific forces into m/s^2."""
        return STANDARD_GRAVITY if self.acc_unit == "g" else 1.0


class PositionSensor(Sensor):
    """A sensor of the position of one point of the machine in n.

    A kind of one's own is a subclass with ``sigma_at(position_n)``: standard deviations [m] of fixes at (n, 3) m, (n,)
    or (n, 3) per axis.
    """

    arm_m: Triple = Field(ZERO, description="Lever arm: from the IMU to the point, in b.")
    arm_sd_m: CalibrationSd = Field(0.0, description="Per axis; 0 or null: the arm is not estimated.")
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time; positive when stamps are late.")
    clock_offset_sd_s: CalibrationSd = Field(0.0, description="0 or null: the offset is not estimated.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    arm = si("arm_m")
    arm_sd = si("arm_sd_m")
    clock_offset = si("clock_offset_s")
    clock_offset_sd = si("clock_offset_sd_s")


class Prism(PositionSensor):
    """Prism tracked by a total station; sd per axis = sigma_mm + sigma_ppm x range.

    The defaults are the usual statement for kinematic tracking, 3 mm + 1.5 ppm.
    """

    sigma_mm: Positive = Field(3.0, description="Constant part per axis.")
    sigma_ppm: NotNegative = Field(1.5, description="Part that grows with range, mm per km.")
    station_m: Triple = Field(ZERO, description="Where the total station stands in n, for the range.")
    # fixes on another reflector are metres off and come in runs: what pulls with all its weight must not pull at all
    loss: Loss = Field("cauchy", description="Weight of outliers in the graph.")

    station = si("station_m")

    def sigma_at(self, position_n: Floats) -> Floats:
        """Standard deviation per axis [m] of fixes at ``position_n`` (..., 3) -> (...)."""
        ranges = np.linalg.norm(np.asarray(position_n) - self.station, axis=-1)
        return self.sigma_mm * MM + self.sigma_ppm * PPM * ranges


class Gnss(PositionSensor):
    """Satellite positions, turned into n."""

    sigma_m: Positive | None = Field(None, description="Per axis; null: the covariance that each fix states.")

    sigma = si("sigma_m")


class Odometer(Sensor):
    """Speed over ground along the odometer's own forward axis: indicated = (1 + scale) x true.

    The default sds are those of an encoder on a crawler: a few centimetres per second of slip and chatter.
    """

    sigma_mps: Positive = Field(0.02, description="White noise of the speed, per sample.")
    lateral_sigma_mps: Positive = Field(
        0.02, description="Of the assumption that the contact point neither slides sideways nor lifts, per sample."
    )
    scale: Annotated[Number, Field(gt=-1)] = Field(0.0, description="Scale error, dimensionless.")
    scale_sd: CalibrationSd = Field(0.0, description="0 or null: the scale is not estimated.")
    arm_m: Triple = Field(ZERO, description="From the IMU to the contact point, in b.")
    yaw_deg: Number = Field(0.0, description="Forward axis of the odometer in b: rotation about z.")
    pitch_deg: Number = Field(0.0, description="Forward axis of the odometer in b: rotation about y.")
    mounting_sd_deg: CalibrationSd = Field(0.0, description="Of yaw and pitch; 0 or null: not estimated.")
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    sigma = si("sigma_mps")
    lateral_sigma = si("lateral_sigma_mps")
    arm = si("arm_m")
    yaw = si("yaw_deg", DEG)
    pitch = si("pitch_deg", DEG)
    mounting_sd = si("mounting_sd_deg", DEG)
    clock_offset = si("clock_offset_s")

    @property
    def ahead(self) -> Floats:
        """The odometer's forward axis in b, (3,)."""
        return _rotation((0.0, self.pitch_deg, self.yaw_deg))[:, 0]


class Magnetometer(Sensor):
    """Direction of the horizontal magnetic field. The default sd is for a calibrated unit beside steel."""

    unit: Literal["T", "G", "uT", "nT"] = Field("T", description="Unit of the messages; ROS has T.")
    sigma_deg: Positive = Field(2.0, description="Of the horizontal direction, per sample.")
    disturbance_deg: NotNegative = Field(0.0, description="Sd of a local field's turn of it, which does not average.")
    disturbance_s: Positive = Field(1.0, description="How long such a turn lasts, on the move: correlation time.")
    declination_deg: Number = Field(0.0, description="Magnetic north from true north, east positive.")
    declination_sd_deg: CalibrationSd = Field(0.0, description="0 or null: the declination is not estimated.")
    hard_iron_ut: Triple = Field(ZERO, description="Field of the machine in sensor axes, microtesla; subtracted.")
    hard_iron_sd_ut: CalibrationSd = Field(0.0, description="Per axis; 0 or null: the hard iron is not estimated.")
    rpy_deg: Triple = Field(ZERO, description="Turns sensor axes into b: roll, pitch, yaw.")
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time; the delay of the sensor's filter is part.")
    clock_offset_sd_s: CalibrationSd = Field(0.0, description="0 or null: the offset is not looked for in the log.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    sigma = si("sigma_deg", DEG)
    disturbance = si("disturbance_deg", DEG)
    disturbance_time = si("disturbance_s")
    declination = si("declination_deg", DEG)
    declination_sd = si("declination_sd_deg", DEG)
    hard_iron = si("hard_iron_ut", MICRO_TESLA)
    clock_offset = si("clock_offset_s")
    clock_offset_sd = si("clock_offset_sd_s")

    @property
    def R_bm(self) -> Floats:
        """Rotation from the sensor's axes to b, (3, 3)."""
        return _rotation(self.rpy_deg)


class Barometer(Sensor):
    """Height from air pressure, with a wandering bias. Defaults: a MEMS barometer in ventilated air."""

    unit: Literal["Pa", "hPa", "kPa"] = Field("Pa", description="Unit of the messages; ROS has Pa.")
    sigma_m: Positive = Field(0.2, description="White noise of the height, per sample.")
    bias_sd_m: CalibrationSd = Field(10.0, description="Of the bias at the start; 0 or null: not estimated.")
    bias_walk: NotNegative = Field(0.01, description="Random walk of the bias, m/sqrt(s).")
    air_c: Number | None = Field(None, description="Temperature of the air column; null: the standard atmosphere's.")
    scale_sd: CalibrationSd = Field(
        0.0, description="Of the scale of height, 0.0035 for each degree that air_c may be wrong; 0 or null: known."
    )
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    sigma = si("sigma_m")
    bias_sd = si("bias_sd_m")
    clock_offset = si("clock_offset_s")

    def scale_at(self, height_m: float) -> float:
        """Scale of pressure heights about ``height_m`` in the standard atmosphere: warm air is thin, so they are short;
        ISO 2533, 288.15 K at sea level and 6.5 K less each km up."""
        return 0.0 if self.air_c is None else (288.15 - 0.0065 * height_m) / (273.15 + self.air_c) - 1.0


class Laser(Sensor):
    """Spot of a fixed laser on the machine's detector, in the detector's own x and y. Defaults: a plumb laser."""

    unit: Literal["m", "mm"] = Field("m", description="Unit of the messages; ROS has m.")
    sigma_mm: Positive = Field(0.2, description="Of the spot, per axis.")
    half_width_mm: Positive | None = Field(
        None, description="Of the detector: a spot at its edge or beyond is left out; null: not checked."
    )
    T_bd: Mounting = Field(
        Mounting(), description="The detector in b; with x forward and y right its z points down: rpy_deg [180, 0, 0]."
    )
    line_m: tuple[Number, Number] = Field((0.0, 0.0), description="x, y of n where the laser's line passes z = 0.")
    tilt_deg: tuple[Number, Number] = Field((0.0, 0.0), description="Of the line from plumb, towards n's x and y.")
    tilt_sd_deg: CalibrationSd = Field(0.0, description="Per axis; 0 or null: the tilt is not estimated.")
    offset_sd_mm: CalibrationSd = Field(0.0, description="Of the reading's zero, per axis; 0 or null: not estimated.")
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time.")
    loss: Loss = Field("huber", description="Weight of outliers, such as light scattered by dust, in the graph.")

    sigma = si("sigma_mm", MM)
    line = si("line_m")
    tilt = si("tilt_deg", DEG)
    tilt_sd = si("tilt_sd_deg", DEG)
    offset_sd = si("offset_sd_mm", MM)
    half_width = si("half_width_mm", MM)
    clock_offset = si("clock_offset_s")


class Lidar(Sensor):
    """Scanning LiDAR. The defaults suit roadways and halls."""

    T_bl: Mounting = Field(Mounting(), description="The LiDAR in b.")
    T_bl_xyz_sd_m: CalibrationSd = Field(0.0, description="Of T_bl.xyz_m per axis; 0 or null: not estimated.")
    T_bl_rpy_sd_deg: CalibrationSd = Field(0.0, description="Of T_bl's rotation per axis; 0 or null: not estimated.")
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time.")
    time_field: Text | None = Field(None, description="Points' own times; null: the field that is usually it.")
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = Field("auto", description="Of the points' own times.")
    min_range_m: NotNegative = Field(0.5, description="Nearer points are the machine itself.")
    max_range_m: Positive = Field(100.0, description="Farther points are not used.")
    voxel_m: Positive = Field(0.5, description="Size of the pieces that surfaces are cut into.")
    noise_factor: Positive = Field(1.0, description="Multiplies the sds of the odometry.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    xyz_sd = si("T_bl_xyz_sd_m")
    rpy_sd = si("T_bl_rpy_sd_deg", DEG)
    clock_offset = si("clock_offset_s")
    min_range = si("min_range_m")
    max_range = si("max_range_m")
    voxel = si("voxel_m")


OWN_KINDS: dict[str, type[Sensor]] = {
    "imu": Imu,
    "prism": Prism,
    "gnss": Gnss,
    "odometer": Odometer,
    "magnetometer": Magnetometer,
    "barometer": Barometer,
    "laser": Laser,
    "lidar": Lidar,
}
KINDS: Registry[type[Sensor]] = Registry("tbmfg.sensors", OWN_KINDS)


def kind_of(name: str) -> str:
    """The kind of a sensor called ``name``: what stands before the first dash."""
    return name.partition("-")[0]


# ---- what is known beside the sensors ----


class ZeroVelocity(Node):
    """The machine is taken to stand where the IMU shows nothing else."""

    enabled: Flag = Field(True, description="Off for machines that glide.")
    sigma_mps: Positive = Field(0.005, description="Of the velocity while standing, per axis.")
    turn_deg_rts: Positive = Field(0.02, description="Random walk of the attitude while standing, deg/sqrt(s).")

    sigma = si("sigma_mps")
    turn = si("turn_deg_rts", DEG)


class Motion(Node):
    """The volume and speed that the machine cannot leave."""

    radius_m: Positive = Field(description="Of the volume about the start.")
    speed_mps: Positive = Field(description="Largest speed.")

    radius = si("radius_m")
    speed = si("speed_mps")


class Deviation(Node):
    """What counts as no deviation of a shaft machine, which a laser's spot and the angles tell together. The bands
    should be wider than the estimate's noise: a yaw outside its own always means stop."""

    reference_deg: Number = Field(
        0.0,
        description="Direction of the shaft's reference in n, counter-clockwise from n's x axis; yaw counts from it.",
    )
    angle_tolerance_deg: Positive = Field(0.2, description="Roll and pitch within this are zero.")
    yaw_tolerance_deg: Positive = Field(0.2, description="Yaw within this is zero.")
    spot_tolerance_mm: Positive = Field(1.0, description="A spot coordinate within this is zero.")
    release: Annotated[Number, Field(gt=0, le=1)] = Field(
        0.7, description="A deviation is over below this share of its tolerance; 1: no hysteresis."
    )
    window_s: NotNegative = Field(2.0, description="Of the running median; a change of less than half of it is noise.")

    reference = si("reference_deg", DEG)
    angle_tolerance = si("angle_tolerance_deg", DEG)
    yaw_tolerance = si("yaw_tolerance_deg", DEG)
    spot_tolerance = si("spot_tolerance_mm", MM)
    window = si("window_s")


class TruthTopic(Node):
    """Where the log holds reference poses. They are compared with, never used."""

    topic: Text = Field(description="Odometry or PoseStamped topic.")
    arm_m: Triple = Field(ZERO, description="From the IMU to the point whose positions they are, in b.")
    sensor: Text | None = Field(
        None, description="Sensor of the same point on the same clock: its arm and offset count, as found."
    )

    arm = si("arm_m")


class SurveyPoint(Node):
    """A surveyed position of b in n."""

    at: Moment = Field(description="start, end, or seconds from the first IMU sample.")
    position_m: Triple = Field(description="In n.")
    sigma_m: Positive = Field(description="Per axis.")

    position = si("position_m")
    sigma = si("sigma_m")


class Rig(Node):
    """One machine and the log it writes. Everything but the topics has a default."""

    name: Text = Field("rig", description="Shown in reports.")
    origin: Origin = Field(Origin(), description="Place and orientation of n.")
    initial: Initial = Field(Initial(), description="Prior of the first state.")
    keyframes: Keyframes = Field(Keyframes(), description="When the estimators hold a state.")
    lag_s: Positive = Field(5.0, description="Length of the window of the fixed-lag smoother.")
    sensors: dict[str, SerializeAsAny[Sensor]] = Field(
        description="By name; the part before the first dash is the kind (prism-left is a prism)."
    )
    zero_velocity: ZeroVelocity = Field(ZeroVelocity(), description="Use of standstill.")
    motion: Motion | None = Field(None, description="Bound on the motion; null: none.")
    deviation: Deviation = Field(Deviation(), description="Bands of the deviation that a laser shows.")
    truth: TruthTopic | None = Field(None, description="Reference in the log; null: none named.")
    survey: tuple[SurveyPoint, ...] = Field((), description="Surveyed positions.")
    estimators: dict[str, dict[str, Any]] = Field({}, description="Switches of single estimators, by their name.")

    lag = si("lag_s")

    @property
    def imu(self) -> Imu:
        return self.sensors["imu"]

    def of_kind(self, kind: str) -> dict[str, Any]:
        """The sensors of one kind, by name, in the order of the file."""
        return {name: sensor for name, sensor in self.sensors.items() if kind_of(name) == kind}

    def assumptions(self) -> list[str]:
        """What the rig leaves open and how it is filled: lines to show the user."""
        said = []
        if self.origin.latitude_deg is None and not self.of_kind("gnss"):
            said.append(f"origin.latitude_deg is not given: no Earth rate, standard gravity {STANDARD_GRAVITY} m/s^2")
        if self.initial.yaw_deg is not None and self.initial.yaw_sd_deg >= 180:
            said.append(f"initial.yaw_deg {self.initial.yaw_deg:g} has no weight: yaw_sd_deg is 180")
        return said

    @field_validator("sensors", mode="before")
    @classmethod
    def _by_kind(cls, given: Any) -> Any:
        """Each mapping to the class that its name asks for; the faults of all of them together."""
        if not isinstance(given, dict):
            return given
        sensors, faults = {}, []
        for name, fields in given.items():
            kind = KINDS.get(kind_of(name))
            if kind is None:
                hint = near(kind_of(name), KINDS) or f"; there are {', '.join(KINDS)}"
                faults.append(fault((name,), f"no such kind of sensor{hint}"))
                continue
            if not re.fullmatch(r"\w+(-\w+)*", name):
                faults.append(fault((name,), "a sensor's name is its kind, then -words of letters and digits"))
                continue
            try:
                sensors[name] = kind.model_validate(fields)
            except ValidationError as error:
                faults += [
                    fault((name, *e["loc"]), e["msg"], e["input"], e["type"]) for e in error.errors(include_url=False)
                ]
        return or_raise(sensors, faults)

    @model_validator(mode="after")
    def _consistent(self) -> Rig:
        """What no single field can know."""
        faults = []
        if list(self.of_kind("imu")) != ["imu"]:
            holds = f", not {', '.join(self.sensors)}" if self.sensors else ""
            return or_raise(self, [fault(("sensors",), f"should hold one IMU, called imu{holds}")])
        if any(self.imu.T_bi.xyz_m):
            reason = "should be zero, b has its origin at the IMU; move the other sensors' arms instead"
            faults.append(fault(("sensors", "imu", "T_bi", "xyz_m"), reason))
        first_with: dict[str, str] = {}
        for name, sensor in self.sensors.items():
            other = first_with.setdefault(sensor.topic, name)
            if other != name:
                faults.append(fault(("sensors", name, "topic"), f"{sensor.topic} is already the topic of {other}"))
        if self.origin.longitude_deg is not None and self.origin.latitude_deg is None:
            faults.append(fault(("origin", "longitude_deg"), "should come with latitude_deg"))
        if self.truth is not None and self.truth.sensor is not None:
            seen = [name for name, sensor in self.sensors.items() if isinstance(sensor, PositionSensor)]
            if self.truth.sensor not in seen:
                reason = f"should be a sensor of positions ({', '.join(seen) or 'none here'})"
                faults.append(fault(("truth", "sensor"), reason))
            if any(self.truth.arm_m):
                faults.append(fault(("truth", "arm_m"), f"should be left out, it is that of {self.truth.sensor}"))
        if (self.initial.roll_deg is None) != (self.initial.pitch_deg is None):
            faults.append(fault(("initial",), "roll_deg and pitch_deg should be given together or not at all"))
        return or_raise(self, faults)


# ---- reading ----

Switches = TypeVar("Switches", bound=Node)


def shipped() -> list[str]:
    """Names of the rigs that come with tbmfg."""
    return sorted(item.name.removesuffix(".yaml") for item in _rigs().iterdir() if item.name.endswith(".yaml"))


def load_rig(name_or_path: str | Path) -> Rig:
    """A shipped rig by its name, or a rig file. A file that is called like a shipped rig needs its path: ``./tbm``."""
    given = str(name_or_path)
    if given in shipped():
        return parse_rig((_rigs() / f"{given}.yaml").read_text("utf-8"), f"{given}.yaml")
    try:
        return parse_rig(Path(given).read_text("utf-8-sig"), given)
    except FileNotFoundError:
        known = shipped()
        hint = near(given, known) or f"; shipped are {', '.join(known)}"
        raise RigError(f"{given}: neither a file nor a shipped rig{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"{given}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8 text'}") from error


def parse_rig(text: str, source: str) -> Rig:
    """The rig in ``text``; ``source`` names it in messages."""
    data, lines = yamltext.parse(text, source)

    def where(path: KeyPath) -> tuple[str, int]:
        return source, next(lines[path[:n]] for n in range(len(path), -1, -1) if path[:n] in lines)

    return _validated(data, where)


def dump_rig(rig: Rig) -> str:
    """The rig as YAML, defaults written out; :func:`parse_rig` gives an equal rig back."""
    return yamltext.dump(_plain(rig))


def override(rig: Rig, assignments: Iterable[str]) -> Rig:
    """``rig`` with values replaced: ``sensors.prism.sigma_mm=2``; the value is YAML, numbers index lists."""
    data = _plain(rig)
    by_path: dict[KeyPath, str] = {}
    for assignment in assignments:
        source = f"--set {assignment}"
        key, equals, text = assignment.partition("=")
        if not equals or not all(key.strip().split(".")):
            raise RigError(f"{source}: should read key.path=value")
        path = tuple(key.strip().split("."))
        by_path[_assign(data, path, yamltext.parse(text, source)[0], source)] = source

    def where(path: KeyPath) -> tuple[str]:
        touching = (source for at, source in by_path.items() if at[: len(path)] == path[: len(at)])
        return (next(touching, rig.name),)

    return _validated(data, where)


def switches(rig: Rig, estimator: str, model: type[Switches]) -> Switches:
    """The rig's switches of one estimator, ``estimators.NAME`` in the file, as its model. Raises RigError for keys and
    values that the estimator does not know."""
    try:
        return model.model_validate(rig.estimators.get(estimator, {}))
    except ValidationError as error:
        faults = [explain(e, lambda path: model.model_fields) for e in error.errors(include_url=False)]
    raise RigError("\n".join(f"{rig.name}: estimators.{estimator}.{reason}" for reason in faults))


def _assign(data: Any, path: tuple[str, ...], value: Any, source: str) -> KeyPath:
    """Put ``value`` at ``path`` of ``data``; the path with list indices as integers. The last key may be new."""
    done: list[str | int] = []
    for position, key in enumerate(path):
        last = position == len(path) - 1
        if isinstance(data, list):
            if not (key.isdecimal() and int(key) < len(data)):
                raise RigError(f"{source}: {dotted(tuple(done))} has no item {key!r} (items 0 to {len(data) - 1})")
            key = int(key)
        elif not isinstance(data, dict):
            raise RigError(f"{source}: {dotted(tuple(done))} is a value, not a mapping")
        elif key not in data and not last and path[0] != "estimators":
            raise RigError(f"{source}: {dotted((*done, key))}: no such key{near(key, data)}")
        done.append(key)
        if last:
            data[key] = value
        else:
            if isinstance(data, dict) and data.get(key) is None:
                data[key] = {}  # a part that is null by default, such as truth
            data = data[key]
    return tuple(done)


def _plain(rig: Rig) -> dict[str, Any]:
    return rig.model_dump(mode="json")


def _rigs() -> Any:
    return resources.files("tbmfg") / "rigs"


def _validated(data: Any, where: Callable[[KeyPath], tuple]) -> Rig:
    """The rig in ``data``, or every fault in it by the place ``where`` its key was given."""
    try:
        return Rig.model_validate(data)
    except ValidationError as error:
        faults = sorted((where(e["loc"]), explain(e, _keys_beside)) for e in error.errors(include_url=False))
    raise RigError("\n".join(f"{':'.join(map(str, place))}: {reason}" for place, reason in faults))


def _keys_beside(path: KeyPath) -> Iterable[str]:
    """The keys that the model knows beside the unknown one at the end of ``path``."""
    model: type[BaseModel] = Rig
    parents = [key for key in path[:-1] if isinstance(key, str)]
    if parents[:1] == ["sensors"]:
        model, parents = KINDS[kind_of(parents[1])], parents[2:]
    for key in parents:
        annotation = model.model_fields[key].annotation
        model = next(a for a in (annotation, *get_args(annotation)) if isclass(a) and issubclass(a, Node))
    return model.model_fields
