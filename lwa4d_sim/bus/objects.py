"""The objects of the drives as tables: what the firmware has, and what the `cia402` profile adds to it.

One line an object: index[:sub], type, access, default, limits, flags, unit, name. Sub-index 0 (number of
sub-indices) is implied where a line is missing; ``=`` names an array or record. A default with ``@`` is a constant of
the joint, with ``$`` relative to the node id. Flags: m = may be mapped into a PDO, v = a command or state that 1010
does not store. The high limit of text and byte objects is their longest length. A heading names the source of what
follows; EDS is the file of SCHUNK for firmware 0.63 (ipa320/schunk_robots, Schunk_0_63.dcf).
"""

FIRMWARE = """
# EDS 0.63, communication objects
1000   u32 ro  0x20192  -           -  -       device type
1001   u8  ro  0        -           -  -       error register
1002   u32 ro  0        -           -  -       manufacturer status
1003   =   predefined error field
1003:0 u8  rw  0        -           v  -       number of errors
1003:1 u32 ro  0        -           -  -       newest error
1003:2 u32 ro  0        -           -  -       error before it
1005   u32 rw  0x80     -           -  -       COB-ID SYNC
1008   str const @name  -           -  -       device name
1009   str const -      -           -  -       hardware version
100A   str const 0.63   -           -  -       software version
100C   u16 rw  0        -           -  ms      guard time
100D   u8  rw  0        -           -  -       life time factor
1014   u32 rw  $0x80    -           -  -       COB-ID EMCY
1016   =   consumer heartbeat time
1016:1 u32 rw  0        -           -  ms      consumer heartbeat time 1
1016:2 u32 rw  0        -           -  ms      consumer heartbeat time 2
1016:3 u32 rw  0        -           -  ms      consumer heartbeat time 3
1017   u16 rw  0        0..32767    -  ms      producer heartbeat time
1018   =   identity
1018:1 u32 ro  0        -           -  -       vendor id (unknown, 0 here)
1018:2 u32 ro  0        -           -  -       product code (unknown, 0 here)
1018:3 u32 ro  0x3f     -           -  -       revision number (assumed)
1018:4 u32 ro  $0       -           -  -       serial number (the node id here)
1200   =   SDO server
1200:1 u32 ro  $0x600   -           -  -       COB-ID client to server
1200:2 u32 ro  $0x580   -           -  -       COB-ID server to client
# EDS 0.63, manufacturer objects
2000   u32 rw  0        -           v  -       debug flags
2001   =   debug integers
2001:1 i32 rw  0        -           mv -       debug integer 1
2001:2 i32 rw  0        -           mv -       debug integer 2
2001:3 i32 rw  0        -           mv -       debug integer 3
2001:4 i32 rw  0        -           mv -       debug integer 4
2002   =   debug floats
2002:1 f32 rw  0        -           mv -       debug float 1
2002:2 f32 rw  0        -           mv -       debug float 2
2002:3 f32 rw  0        -           mv -       debug float 3
2002:4 f32 rw  0        -           mv -       debug float 4
2003   str ro  -        0..64       -  -       debug message (EDS: may be mapped; not here)
2004   =   logging
2004:1 u16 rw  0x8001   -           v  -       logging state
2004:2 f32 rw  0        -           v  -       logging trigger time
2007   =   EEPROM parameters
2007:1 oct ro  @image   0..4096     -  -       EEPROM image
2008   str wo  -        0..64       v  -       password
2009   u8  ro  0        -           -  -       user level
200A   u8  wo  0        -           v  -       disconnect or reset
200B   =   error details
200B:1 f32 ro  0        -           -  -       error detail
200B:2 str ro  -        0..64       -  -       error file
200B:3 u16 ro  0        -           -  -       error line
200C   u8  rw  1        0..1        -  -       communication mode (EDS gives no default; 1 = CANopen assumed)
200D   =   board temperature
200D:1 f32 ro  25       -           m  degC    board temperature
200D:2 u32 rw  20000    1000..3600000 - ms     board temperature period
200E   u8  rw  6        -           -  -       SYNC time-out factor
2010   f32 rw  0        -           -  -       current controller KR
2011   f32 rw  0        -           -  -       current controller TN
2012   f32 rw  0        -           -  -       current controller TD
2013   f32 rw  0        -           -  -       current controller KC
2020   f32 rw  0        -           -  -       speed controller KR
2021   f32 rw  0        -           -  -       speed controller TN
2022   f32 rw  0        -           -  -       speed controller TD
2023   f32 rw  0        -           -  -       speed controller KC
2024   f32 rw  0        -           -  -       KS feed-forward
2030   f32 rw  0        -           -  -       position controller KR
2031   f32 rw  0        -           -  -       position controller TN
2032   f32 rw  0        -           -  -       position controller TD
2033   f32 rw  0        -           -  -       position controller KC
2034   f32 rw  0        -           -  -       KP feed-forward
2041   f32 rw  0        -           -  -       delta position
2050   u8  ro  0        -           m  -       extended status
# EDS 0.63, drive objects; limits and rated values from the joint's constants; 6065 assumed
6040   u16 rw  0        -           mv -       controlword
6041   u16 ro  0        -           m  -       statusword
6042   i16 rw  0        -           mv -       vl target velocity
6043   i16 ro  0        -           m  -       vl velocity demand
6044   i16 ro  0        -           m  -       vl velocity actual value
6046   =   vl velocity min max amount
6046:1 u32 rw  0        -           m  mdeg/s  vl velocity min amount
6046:2 u32 rw  @speed   -           m  mdeg/s  vl velocity max amount
6048   =   vl velocity acceleration
6048:1 u32 rw  @acceleration -      m  mdeg/s  vl acceleration delta speed
6048:2 u16 rw  1        -           m  s       vl acceleration delta time
6049   =   vl velocity deceleration
6049:1 u32 rw  @acceleration -      m  mdeg/s  vl deceleration delta speed
6049:2 u16 rw  1        -           m  s       vl deceleration delta time
604C   =   vl dimension factor
604C:1 i32 rw  1        -           -  -       vl dimension factor numerator
604C:2 i32 rw  6000     -           -  -       vl dimension factor denominator
6060   i8  rw  0        -           mv -       modes of operation
6061   i8  ro  0        -           m  -       modes of operation display
6062   i32 ro  0        -           m  mdeg    position demand value
6064   i32 ro  0        -           m  mdeg    position actual value
6065   u32 rw  5000     -           -  mdeg    following error window
606B   i32 ro  0        -           m  mdeg/s  velocity demand value
606C   i32 ro  0        -           m  mdeg/s  velocity actual value
6073   u16 rw  1000     -           m  permil  max current
6075   u32 rw  @current -           -  mA      motor rated current
6077   i16 ro  0        -           m  mA      torque actual value
607A   i32 rw  0        -           mv mdeg    target position
607C   i32 rw  0        -           -  mdeg    home offset
607D   =   software position limit
607D:1 i32 rw  @low     -           -  mdeg    min position limit
607D:2 i32 rw  @high    -           -  mdeg    max position limit
6081   u32 rw  10000    -           m  mdeg/s  profile velocity
6083   u32 rw  @acceleration -      m  mdeg/s2 profile acceleration
6086   i16 rw  0        -           -  -       motion profile type
6098   i8  const 0      -           -  -       homing method
60B2   i16 rw  0        -           mv mA      torque offset
60C0   i16 rw  0        -1..0       -  -       interpolation sub mode
60C1   =   interpolation data record
60C1:1 i32 rw  0        -           mv mdeg    interpolation set-point
60C2   =   interpolation time period
60C2:1 u8  rw  8        -           -  -       interpolation period value
60C2:2 i8  rw  -3       -           -  -       interpolation period exponent
60C3   =   interpolation sync definition
60C3:1 u8  rw  0        -           -  -       synchronize on group
60C3:2 u8  rw  1        -           -  -       ip sync every n events
60C4   =   interpolation data configuration
60C4:1 u32 ro  1        -           -  -       maximum buffer size
60C4:2 u32 rw  0        -           -  -       actual buffer size
60C4:3 u8  rw  0        0..1        -  -       buffer organisation
60C4:4 u16 rw  0        -           -  -       buffer position
60C4:5 u8  wo  1        -           -  byte    size of data record
60C4:6 u8  wo  0        -           v  -       buffer clear
60F4   i32 ro  0        -           m  mdeg    following error actual value
60FD   u32 ro  0        -           m  -       digital inputs
60FE   =   digital outputs
60FE:1 u32 rw  0        -           mv -       physical outputs
60FE:2 u32 rw  0        -           v  -       output mask
6502   u32 ro  0x43     -           -  -       supported drive modes
"""

# What replaces or joins the above in the `cia402` profile. The real firmware has none of it.
EXTENSION = """
# extension, CiA 301 4.2
1003:3 u32 ro  0        -           -  -       error field 3
1003:4 u32 ro  0        -           -  -       error field 4
1003:5 u32 ro  0        -           -  -       error field 5
1003:6 u32 ro  0        -           -  -       error field 6
1003:7 u32 ro  0        -           -  -       error field 7
1003:8 u32 ro  0        -           -  -       error field 8
1006   u32 rw  0        -           -  us      communication cycle period
1010   =   store parameters
1010:1 u32 rw  1        -           v  -       store all parameters
1010:2 u32 rw  1        -           v  -       store communication parameters
1010:3 u32 rw  1        -           v  -       store application parameters
1010:4 u32 rw  1        -           v  -       store manufacturer parameters
1011   =   restore default parameters
1011:1 u32 rw  1        -           v  -       restore all parameters
1011:2 u32 rw  1        -           v  -       restore communication parameters
1011:3 u32 rw  1        -           v  -       restore application parameters
1011:4 u32 rw  1        -           v  -       restore manufacturer parameters
1015   u16 rw  0        -           -  100us   inhibit time EMCY
1019   u8  rw  0        0..240      -  -       synchronous counter overflow value
1029   =   error behaviour
1029:1 u8  rw  0        0..2        -  -       communication error
2F00   dom rw  -        0..65536    v  -       scratch memory (to try SDO transfers on)
# extension, CiA 402-2; option codes' defaults are the standard's but for 6007 (quick stop); windows and speeds assumed
6007   i16 rw  3        0..3        -  -       abort connection option code
603F   u16 ro  0        -           m  -       error code
605A   i16 rw  2        0..8        -  -       quick stop option code
605B   i16 rw  0        0..1        -  -       shutdown option code
605C   i16 rw  1        0..1        -  -       disable operation option code
605D   i16 rw  1        1..4        -  -       halt option code
605E   i16 rw  2        0..4        -  -       fault reaction option code
6066   u16 rw  20       -           -  ms      following error time out
6067   u32 rw  100      -           -  mdeg    position window
6068   u16 rw  10       -           -  ms      position window time
606A   i16 rw  0        -           -  -       sensor selection code
606D   u16 rw  500      -           -  mdeg/s  velocity window
606E   u16 rw  10       -           -  ms      velocity window time
606F   u16 rw  100      -           -  mdeg/s  velocity threshold
6070   u16 rw  10       -           -  ms      velocity threshold time
6071   i16 rw  0        -           mv permil  target torque
6072   u16 rw  1000     -           m  permil  max torque
6074   i16 ro  0        -           m  permil  torque demand
6076   u32 rw  @torque  1..4294967295 - mNm    motor rated torque
6077   i16 ro  0        -           m  permil  torque actual value
6078   i16 ro  0        -           m  permil  current actual value
6079   u32 ro  24000    -           m  mV      DC link circuit voltage
607E   u8  rw  0        -           -  -       polarity
607F   u32 rw  @speed   -           m  mdeg/s  max profile velocity
6080   u32 rw  0        -           m  rpm     max motor speed (0 = no limit)
6082   u32 rw  0        -           m  mdeg/s  end velocity
6084   u32 rw  @acceleration -      m  mdeg/s2 profile deceleration
6085   u32 rw  @acceleration -      m  mdeg/s2 quick stop deceleration
6087   u32 rw  10000    -           m  permil/s torque slope
6098   i8  rw  37       -128..37    -  -       homing method
6099   =   homing speeds
6099:1 u32 rw  5000     -           -  mdeg/s  speed during search for switch
6099:2 u32 rw  1000     -           -  mdeg/s  speed during search for zero
609A   u32 rw  @acceleration -      -  mdeg/s2 homing acceleration
60B0   i32 rw  0        -           mv mdeg    position offset
60B1   i32 rw  0        -           mv mdeg/s  velocity offset
60B2   i16 rw  0        -           mv permil  torque offset
60C5   u32 rw  @acceleration -      m  mdeg/s2 max acceleration
60C6   u32 rw  @acceleration -      m  mdeg/s2 max deceleration
60F2   u16 rw  0        -           -  -       positioning option code
60FA   i32 ro  0        -           m  mdeg/s  control effort
60FF   i32 rw  0        -           mv mdeg/s  target velocity
6402   u16 rw  10       -           -  -       motor type
6502   u32 ro  0x3ef    -           -  -       supported drive modes
"""

# PDOs: transmission type and mapped objects, as 1600 and 1A00 write them; None = not valid after power-on.
# firmware: EDS 0.63, but RPDO 1 with the eight bytes that SCHUNK's tools and the FZI driver expect.
# cia402: extension, chosen for cyclic torque with position and speed beside it.
Pdo = tuple[int, tuple[int, ...] | None]
FIRMWARE_PDOS: dict[int, Pdo] = {
    0x1400: (255, (0x60400010, 0x60B20010, 0x60C10120)),
    0x1401: (255, ()),
    0x1800: (1, (0x60410010, 0x60770010, 0x60640020)),
    0x1801: (1, (0x606B0020, 0x606C0020)),
    0x1802: (1, ()),
    0x1803: (254, ()),
}
EXTENSION_PDOS: dict[int, Pdo] = {
    0x1400: (1, (0x60400010, 0x60710010, 0x607A0020)),
    0x1401: (1, (0x60FF0020, 0x60B20010)),
    0x1402: (1, None),
    0x1403: (1, None),
    0x1800: (1, (0x60410010, 0x60770010, 0x60640020)),
    0x1801: (1, (0x606C0020, 0x60F40020)),
    0x1802: (1, None),
    0x1803: (254, None),
}


def pdo_rows(pdos: dict[int, Pdo], *, extended: bool) -> str:
    """Rows of the communication and mapping records; ``extended`` adds what the firmware's records lack."""
    rows = ["# EDS 0.63" if not extended else "# extension, CiA 301 4.2"]
    for index, (kind, mapped) in pdos.items():
        receive, number = index < 0x1800, (index & 0xFF) + 1
        name = f"{'R' if receive else 'T'}PDO {number}"
        cob_id = (0x80000000 if mapped is None else 0) + 0x100 + 0x100 * number - (0 if receive else 0x80)
        rows += [
            f"{index:X} = {name} communication",
            f"{index:X}:1 u32 rw ${cob_id:#x} - - - {name} COB-ID",
            f"{index:X}:2 u8 rw {kind} - - - {name} transmission type",
        ]
        if extended and not receive:
            rows += [
                f"{index:X}:3 u16 rw 0 - - 100us {name} inhibit time",
                f"{index:X}:6 u8 rw 0 0..240 - - {name} SYNC start value",
            ]
        if extended or not receive:
            rows += [f"{index:X}:5 u16 rw 0 - - ms {name} event timer"]
        table, entries = index + 0x200, mapped or ()
        rows += [f"{table:X} = {name} mapping", f"{table:X}:0 u8 rw {len(entries)} 0..8 - - {name} mapped objects"]
        for k, entry in enumerate((*entries, *(8 - len(entries)) * (0,)), 1):
            rows += [f"{table:X}:{k} u32 rw {entry:#x} - - - {name} mapped object {k}"]
    return "\n".join(rows)
