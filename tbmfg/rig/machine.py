"""The whole machine: where and how it starts, its sensors, and what is known beside them."""

from __future__ import annotations

import re
from typing import Annotated, Any

import numpy as np
from pydantic import Field, SerializeAsAny, ValidationError, field_validator, model_validator

from tbmfg import earth
from tbmfg.fields import (
    DEG,
    MM,
    STANDARD_GRAVITY,
    ZERO,
    Flag,
    Moment,
    Node,
    NotNegative,
    Number,
    Positive,
    Text,
    Triple,
    fault,
    near,
    or_raise,
    si,
)
from tbmfg.rig.sensors import KINDS, Imu, PositionSensor, Sensor, kind_of
from tbmfg.timeseries import Floats

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


# ---- the whole ----


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
            said.append(f"assumed origin.latitude_deg: not given: no Earth rate, gravity {STANDARD_GRAVITY} m/s^2")
        if self.initial.yaw_deg is not None and self.initial.yaw_sd_deg >= 180:
            said.append(f"assumed initial.yaw_deg: {self.initial.yaw_deg:g} counts for nothing, as yaw_sd_deg is 180")
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
