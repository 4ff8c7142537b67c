"""A WebSocket client of a few lines (RFC 6455) that speaks the Foxglove protocol, for the live view's tests."""

import base64
import json
import os
import select
import socket
import struct


class LiveClient:
    """Connects, gathers what the server offers, subscribes, yields messages."""

    def __init__(self, port: int, timeout_s: float = 20.0) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout_s)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            (
                f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
            ).encode()
        )
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._socket.recv(4096)
        head, self._buffer = self._buffer.split(b"\r\n\r\n", 1)
        assert b"101" in head.split(b"\r\n")[0], head
        self.channels: dict[int, dict] = {}
        self.server: dict = {}

    def _take(self, size: int) -> bytes:
        while len(self._buffer) < size:
            more = self._socket.recv(65536)
            if not more:
                raise EOFError
            self._buffer += more
        taken, self._buffer = self._buffer[:size], self._buffer[size:]
        return taken

    def _frame(self) -> tuple[int, bytes]:
        first, second = self._take(2)
        size = second & 0x7F
        if size == 126:
            (size,) = struct.unpack(">H", self._take(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self._take(8))
        return first & 0x0F, self._take(size)

    def _send(self, opcode: int, data: bytes) -> None:
        mask = os.urandom(4)
        size = len(data)
        head = bytes([0x80 | opcode]) + (
            bytes([0x80 | size]) if size < 126 else bytes([0xFE]) + struct.pack(">H", size)
        )
        self._socket.sendall(head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(data)))

    def expect_channels(self, count: int) -> None:
        """Read until the server has offered `count` channels."""
        while len(self.channels) < count:
            opcode, data = self._frame()
            if opcode == 1:
                message = json.loads(data)
                if message["op"] == "serverInfo":
                    self.server = message
                elif message["op"] == "advertise":
                    self.channels |= {channel["id"]: channel for channel in message["channels"]}

    def subscribe(self) -> None:
        """Ask for every channel; the subscription has the channel's id."""
        wanted = [{"id": number, "channelId": number} for number in self.channels]
        self._send(1, json.dumps({"op": "subscribe", "subscriptions": wanted}).encode())

    def hears(self, wait_s: float) -> bool:
        """True once the server has said something more."""
        return bool(self._buffer or select.select([self._socket], [], [], wait_s)[0])

    def message(self) -> tuple[str, int, bytes]:
        """(topic, log time in ns, payload) of the next message; EOFError when the server is gone."""
        while True:
            opcode, data = self._frame()
            if opcode == 8:
                raise EOFError
            if opcode == 9:
                self._send(10, data)
            if opcode == 2 and data[0] == 1:
                number, log_ns = struct.unpack_from("<IQ", data, 1)
                return self.channels[number]["topic"], log_ns, data[13:]
