"""The MAVLink messages that telemetry logs are read for: https://mavlink.io/en/messages/common.html.

Each is declared once, with its fields in the order of the wire: by size, the largest first, then the extensions of
MAVLink 2. The byte that a message adds to its checksum follows from this declaration.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usvlearn.logs.formats.messages import Field

TYPES = {
    "uint64": "<u8", "uint32": "<u4", "int32": "<i4", "uint16": "<u2", "int16": "<i2", "uint8": "u1", "int8": "i1",
    "float": "<f4", "char": "S",
}  # fmt: skip
IMU = (
    "int16 xacc[mG] yacc[mG] zacc[mG] xgyro[mrad/s] ygyro[mrad/s] zgyro[mrad/s] xmag[mgauss] ymag[mgauss] zmag[mgauss]"
)
GPS = "int32 lat[degE7] lon[degE7] alt[mm]"
ESC = "uint16 voltage:4[cV] current:4[cA] totalcurrent:4[mAh] rpm:4[rpm] count:4 uint8 temperature:4[degC]"


def _numbered(name: str, first: int, last: int) -> str:
    return " ".join(f"{name}{n}_raw[us]" for n in range(first, last + 1))


# id, name: types, fields, and units in brackets. `:4`: an array; `+`: the extensions follow; `#`: numbers equal senders
DECLARED = f"""
0 HEARTBEAT: uint32 custom_mode uint8 type autopilot base_mode system_status mavlink_version
1 SYS_STATUS: uint32 onboard_control_sensors_present onboard_control_sensors_enabled onboard_control_sensors_health \
  uint16 load[d%] voltage_battery[mV] int16 current_battery[cA] uint16 drop_rate_comm[c%] errors_comm errors_count1 \
  errors_count2 errors_count3 errors_count4 int8 battery_remaining[%]
2 SYSTEM_TIME: uint64 time_unix_usec[us] uint32 time_boot_ms[ms]
22 PARAM_VALUE: float param_value uint16 param_count param_index char param_id:16 uint8 param_type
24 GPS_RAW_INT: uint64 time_usec[us] {GPS} uint16 eph epv vel[cm/s] cog[cdeg] uint8 fix_type satellites_visible \
  + int32 alt_ellipsoid[mm] uint32 h_acc[mm] v_acc[mm] vel_acc[mm/s] hdg_acc[degE5] uint16 yaw[cdeg]
26 SCALED_IMU: uint32 time_boot_ms[ms] {IMU} + int16 temperature[cdegC]
27 RAW_IMU: uint64 time_usec[us] {IMU} + uint8 id# int16 temperature[cdegC]
29 SCALED_PRESSURE: uint32 time_boot_ms[ms] float press_abs[hPa] press_diff[hPa] int16 temperature[cdegC] \
  + int16 temperature_press_diff[cdegC]
30 ATTITUDE: uint32 time_boot_ms[ms] float roll[rad] pitch[rad] yaw[rad] rollspeed[rad/s] pitchspeed[rad/s] \
  yawspeed[rad/s]
31 ATTITUDE_QUATERNION: uint32 time_boot_ms[ms] float q1 q2 q3 q4 rollspeed[rad/s] pitchspeed[rad/s] yawspeed[rad/s]
32 LOCAL_POSITION_NED: uint32 time_boot_ms[ms] float x[m] y[m] z[m] vx[m/s] vy[m/s] vz[m/s]
33 GLOBAL_POSITION_INT: uint32 time_boot_ms[ms] {GPS} int32 relative_alt[mm] int16 vx[cm/s] vy[cm/s] vz[cm/s] \
  uint16 hdg[cdeg]
35 RC_CHANNELS_RAW: uint32 time_boot_ms[ms] uint16 {_numbered("chan", 1, 8)} uint8 port# rssi
36 SERVO_OUTPUT_RAW: uint32 time_usec[us] uint16 {_numbered("servo", 1, 8)} uint8 port# \
  + uint16 {_numbered("servo", 9, 16)}
62 NAV_CONTROLLER_OUTPUT: float nav_roll[deg] nav_pitch[deg] alt_error[m] aspd_error[m/s] xtrack_error[m] \
  int16 nav_bearing[deg] target_bearing[deg] uint16 wp_dist[m]
65 RC_CHANNELS: uint32 time_boot_ms[ms] uint16 {_numbered("chan", 1, 18)} uint8 chancount rssi
74 VFR_HUD: float airspeed[m/s] groundspeed[m/s] alt[m] climb[m/s] int16 heading[deg] uint16 throttle[%]
105 HIGHRES_IMU: uint64 time_usec[us] float xacc[m/s/s] yacc[m/s/s] zacc[m/s/s] xgyro[rad/s] ygyro[rad/s] \
  zgyro[rad/s] xmag[gauss] ymag[gauss] zmag[gauss] abs_pressure[hPa] diff_pressure[hPa] pressure_alt \
  temperature[degC] uint16 fields_updated + uint8 id#
116 SCALED_IMU2: uint32 time_boot_ms[ms] {IMU} + int16 temperature[cdegC]
124 GPS2_RAW: uint64 time_usec[us] {GPS} uint32 dgps_age[ms] uint16 eph epv vel[cm/s] cog[cdeg] uint8 fix_type \
  satellites_visible dgps_numch + uint16 yaw[cdeg] int32 alt_ellipsoid[mm] uint32 h_acc[mm] v_acc[mm] vel_acc[mm/s] \
  hdg_acc[degE5]
125 POWER_STATUS: uint16 Vcc[mV] Vservo[mV] flags
129 SCALED_IMU3: uint32 time_boot_ms[ms] {IMU} + int16 temperature[cdegC]
163 AHRS: float omegaIx[rad/s] omegaIy[rad/s] omegaIz[rad/s] accel_weight renorm_val error_rp error_yaw
168 WIND: float direction[deg] speed[m/s] speed_z[m/s]
178 AHRS2: float roll[rad] pitch[rad] yaw[rad] altitude[m] int32 lat[degE7] lng[degE7]
193 EKF_STATUS_REPORT: float velocity_variance pos_horiz_variance pos_vert_variance compass_variance \
  terrain_alt_variance uint16 flags + float airspeed_variance
226 RPM: float rpm1 rpm2
11030 ESC_TELEMETRY_1_TO_4: {ESC}
11031 ESC_TELEMETRY_5_TO_8: {ESC}
"""


class Message(NamedTuple):
    """A message of the wire."""

    name: str
    extra: int  # the byte that it adds to its checksum
    fields: dict[str, Field]
    stamp: str | None  # the field that tells when it was sent, since boot
    instance: str | None  # the field that numbers equal senders


def _parse(line: str) -> tuple[int, Message]:
    """The id and the message of a declaration."""
    head, _, body = line.partition(":")
    number, name = head.split()
    crc, base, kind, offset, instance = _checksum(f"{name} "), True, "", 0, None
    fields: dict[str, Field] = {}
    for word in body.split():
        if word == "+" or word in TYPES:
            base, kind = base and word != "+", word
            continue
        field, _, unit = word.rstrip("]").partition("[")
        field, _, count = field.partition(":")
        if field.endswith("#"):
            field = instance = field[:-1]
        if base:
            crc = _checksum(f"{kind}{'' if kind in ('float', 'char') else '_t'} {field} ", crc)
            crc = _checksum(chr(int(count)), crc) if count else crc
        dtype = TYPES[kind] + (count if kind == "char" else "")
        for k in range(int(count)) if count and kind != "char" else [None]:
            fields[field if k is None else f"{field}.{k}"] = Field(offset, dtype, unit=unit)
            offset += np.dtype(dtype).itemsize
    stamp = next((each for each in ("time_boot_ms", "time_usec") if each in fields), None)
    return int(number), Message(name, crc & 255 ^ crc >> 8, fields, stamp, instance)


def _checksum(text: str, crc: int = 0xFFFF) -> int:
    """X.25 (CRC-16/MCRF4XX)."""
    for byte in text.encode():
        x = byte ^ crc & 255
        x = (x ^ x << 4) & 255
        crc = crc >> 8 ^ x << 8 ^ x << 3 ^ x >> 4
    return crc


MESSAGES: dict[int, Message] = dict(_parse(line) for line in DECLARED.strip().splitlines())
