# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A cable that loses packets: passes Ethernet frames between two interfaces, but for some of those with IP in them.

    python -m benchmarks.network.relay port2 spare2 --loss 0.01

This kernel has no netem. Which packets are lost is drawn with a fixed seed, each for itself, whatever they carry: an
image over UDP and the requests to repeat it alike. What the outgoing interface has no room for is lost as well, as in a
switch.
"""

from __future__ import annotations

import argparse
import array
import fcntl
import random
import select
import socket
import struct
from contextlib import suppress

__all__ = ["send_whole_packets"]

_ETH_P_ALL, _ETH_P_IP = 0x0003, 0x0800
# Of linux/if_packet.h: do not hand out what this host sends itself.
_SOL_PACKET, _IGNORE_OUTGOING = 263, 23
# Of linux/sockios.h and linux/ethtool.h: leave checksums and the splitting of large packets to no card.
_SIOCETHTOOL = 0x8946
_OFFLOADS = (0x17, 0x1F, 0x24)  # transmit checksums, TCP and generic segmentation
_BUFFER = 32 * 2**20
# An Ethernet frame of 1500 bytes of payload, with room for a tag.
_LARGEST = 2048


def send_whole_packets(interface: str) -> None:
    """Make the packets of an interface what a cable would carry: complete, and no larger than its MTU."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        for feature in _OFFLOADS:
            value = array.array("I", [feature, 0])
            request = struct.pack("16sP", interface.encode(), value.buffer_info()[0])
            # A card that cannot do it does not do it.
            with suppress(OSError):
                fcntl.ioctl(any_socket, _SIOCETHTOOL, request)


def _open(interface: str) -> socket.socket:
    made = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL))
    made.bind((interface, 0))
    made.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
    # Beyond what net.core.rmem_max allows; only root may.
    made.setsockopt(socket.SOL_SOCKET, getattr(socket, "SO_RCVBUFFORCE", 33), _BUFFER)
    made.setblocking(False)
    return made


def _pass_on(ends: tuple[socket.socket, socket.socket], loss: float, seed: int) -> None:
    draw = random.Random(seed).random
    other = {ends[0]: ends[1], ends[1]: ends[0]}
    while True:
        for source in select.select(ends, [], [])[0]:
            with suppress(BlockingIOError):
                while True:
                    frame = source.recv(_LARGEST)
                    is_ip = int.from_bytes(frame[12:14], "big") == _ETH_P_IP
                    if not (is_ip and draw() < loss):
                        # The queue of the interface may be full.
                        with suppress(OSError):
                            other[source].send(frame)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("interfaces", nargs="+", help="the two ends; or one, with --prepare")
    parser.add_argument("--loss", type=float, default=0.01, help="fraction of the IP packets")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--prepare", action="store_true", help="only send_whole_packets")
    options = parser.parse_args()
    for interface in options.interfaces:
        send_whole_packets(interface)
    if not options.prepare:
        first, second = map(_open, options.interfaces)
        print("ready", flush=True)
        _pass_on((first, second), options.loss, options.seed)


if __name__ == "__main__":
    main()
