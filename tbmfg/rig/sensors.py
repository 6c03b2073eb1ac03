"""The kinds of sensors, and how each is mounted, how well it measures and what of it is estimated."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

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
    Node,
    NoiseFactor,
    NotNegative,
    Number,
    Positive,
    Text,
    Triple,
    noise,
    si,
)
from tbmfg.registry import Registry
from tbmfg.timeseries import Floats


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


class Sensor(Node):
    """What every sensor has: the topic it is recorded under."""

    topic: Text = Field(description="Topic in the log.")
    noise_factor: NoiseFactor = Field(
        1.0,
        description="Multiplies the sensor's own noise; auto: found from the log, by what the smoother leaves of it.",
    )

    @property
    def times(self) -> float:
        """The noise factor; 1 while it is still to be found."""
        return 1.0 if self.noise_factor == "auto" else self.noise_factor


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
    clock_drift_ppm: Number = Field(
        0.0, description="By how much the offset grows; clock_offset_s is then that of the log's start."
    )
    clock_drift_sd_ppm: CalibrationSd = Field(
        0.0, description="Of two quartz clocks 10 or so; 0 or null: the drift is not estimated."
    )
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    arm = si("arm_m")
    arm_sd = si("arm_sd_m")
    clock_offset = si("clock_offset_s")
    clock_offset_sd = si("clock_offset_sd_s")
    clock_drift = si("clock_drift_ppm", PPM)
    clock_drift_sd = si("clock_drift_sd_ppm", PPM)


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

    sigma = noise("sigma_mps")
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
    hard_iron_sd_ut: CalibrationSd = Field(
        0.0,
        description="Per axis; 0 or null: the hard iron is not estimated. A machine that keeps its heading shows what "
        "lies across the field alone.",
    )
    rpy_deg: Triple = Field(ZERO, description="Turns sensor axes into b: roll, pitch, yaw.")
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time; the delay of the sensor's filter is part.")
    clock_offset_sd_s: CalibrationSd = Field(0.0, description="0 or null: the offset is not looked for in the log.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    sigma = noise("sigma_deg", DEG)
    disturbance = si("disturbance_deg", DEG)
    disturbance_time = si("disturbance_s")
    declination = si("declination_deg", DEG)
    declination_sd = si("declination_sd_deg", DEG)
    hard_iron = si("hard_iron_ut", MICRO_TESLA)
    hard_iron_sd = si("hard_iron_sd_ut", MICRO_TESLA)
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
    lapse_sd_kpkm: CalibrationSd = Field(
        0.0, description="Of the air's cooling with height about the standard atmosphere's 6.5 K/km; 0 or null: known."
    )
    clock_offset_s: Number = Field(0.0, description="Stamp minus IMU time.")
    loss: Loss = Field("huber", description="Weight of outliers in the graph.")

    sigma = noise("sigma_m")
    bias_sd = si("bias_sd_m")
    lapse_sd = si("lapse_sd_kpkm", 1e-3)
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

    sigma = noise("sigma_mm", MM)
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
