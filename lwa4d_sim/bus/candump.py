"""Logs as `candump -L` writes them, which can-utils, Wireshark and python-can read.

python-can's own writer marks each frame as received or sent, at which Wireshark 4.0 stumbles.
"""

from pathlib import Path

import can

ERROR_FLAG = 0x2000_0000  # CAN_ERR_FLAG, linux/can.h


class CandumpLog(can.Listener):
    """One log file.

    Args:
        path: of the file; an old one is replaced.
        interface: name written for frames that bring none with them.
    """

    def __init__(self, path: Path, interface: str = "vcan0") -> None:
        self._file = path.open("w", encoding="ascii", newline="\n")
        self._interface = interface

    def on_message_received(self, msg: can.Message) -> None:
        """Write a frame of a classic bus."""
        digits = 8 if msg.is_extended_id or msg.is_error_frame else 3
        can_id = msg.arbitration_id | (ERROR_FLAG if msg.is_error_frame else 0)
        data = f"R{msg.dlc or ''}" if msg.is_remote_frame else msg.data.hex().upper()
        channel = msg.channel if isinstance(msg.channel, str) and " " not in msg.channel else self._interface
        self._file.write(f"({msg.timestamp:.6f}) {channel} {can_id:0{digits}X}#{data}\n")

    def stop(self) -> None:
        """Close the file."""
        self._file.close()
