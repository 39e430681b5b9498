"""The canopen library's SDO client without its threads: whoever waits for an answer lets the bus run meanwhile."""

import logging
from collections.abc import Callable

import can
import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError, SdoError

from lwa4d_sim.errors import BusError

RESPONSE_TIMEOUT = 0.3  # [s], the canopen library's own

# What goes wrong reaches the user as an error of ours, once.
logging.getLogger("canopen").addHandler(logging.NullHandler())

Wait = Callable[[float, Callable[[], bool]], bool]


class Client(canopen.Network):
    """SDO requests over any way of sending and waiting.

    Args:
        send: puts a frame on the bus.
        wait: lets the bus run until a condition holds or so many seconds have passed; says whether it held.
    """

    def __init__(self, send: Callable[[can.Message], None], wait: Wait) -> None:
        super().__init__()
        self._put, self.wait = send, wait

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame; called by the library."""
        self._put(can.Message(arbitration_id=can_id, data=data, is_remote_frame=remote, is_extended_id=False))

    def read(self, node: int, index: int, sub: int = 0) -> bytes:
        """Value of an object.

        Raises:
            BusError: the node refuses or does not answer.
        """
        try:
            return bytes(self._server(node).upload(index, sub))
        except SdoError as error:
            raise _refused(node, index, sub, "read", error) from error

    def write(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object.

        Raises:
            BusError: the node refuses or does not answer.
        """
        try:
            self._server(node).download(index, sub, data)
        except SdoError as error:
            raise _refused(node, index, sub, "write", error) from error

    def _server(self, node: int) -> SdoClient:
        if node not in self.nodes:
            self.add_node(_Remote(node, canopen.ObjectDictionary()))
        server = self.nodes[node].sdo
        assert isinstance(server, SdoClient)
        return server


class _Remote(canopen.RemoteNode):
    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> SdoClient:
        client = _Sdo(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        if self.has_network():
            self.network.subscribe(client.tx_cobid, client.on_response)
        return client


class _Sdo(SdoClient):
    def read_response(self) -> bytes:
        network = self.network
        assert isinstance(network, Client)
        if not network.wait(RESPONSE_TIMEOUT, lambda: not self.responses.empty()):
            raise SdoCommunicationError("no answer")
        return bytes(super().read_response())


def _refused(node: int, index: int, sub: int, what: str, error: Exception) -> BusError:
    reason = str(error)
    if isinstance(error, SdoAbortedError):
        reason = f"{SdoAbortedError.CODES.get(error.code, 'unknown reason')} (SDO abort 0x{error.code:08X})"
    return BusError(f"node {node}: cannot {what} object 0x{index:04X}:{sub:02X}: {reason}")
