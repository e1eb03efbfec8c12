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

"""SROS2 policies read, and a DDS security keystore made of them with the ``openssl`` command.

Layout and policy schema are those of SROS2 (https://github.com/ros2/sros2, policy.xsd); governance and permissions
those of DDS Security 1.1, 9.4.1 (https://www.omg.org/spec/DDS-SECURITY/1.1).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

# What a service consists of: the DDS topics of requests and of replies.
_REQUEST = "rq{}Request"
_REPLY = "rr{}Reply"
_GRAPH = "ros_discovery_info"

_GOVERNANCE = """\
<dds><domain_access_rules><domain_rule>
<domains><id>{domain}</id></domains>
<allow_unauthenticated_participants>false</allow_unauthenticated_participants>
<enable_join_access_control>true</enable_join_access_control>
<discovery_protection_kind>ENCRYPT</discovery_protection_kind>
<liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
<rtps_protection_kind>SIGN</rtps_protection_kind>
<topic_access_rules><topic_rule>
<topic_expression>*</topic_expression>
<enable_discovery_protection>true</enable_discovery_protection>
<enable_liveliness_protection>true</enable_liveliness_protection>
<enable_read_access_control>true</enable_read_access_control>
<enable_write_access_control>true</enable_write_access_control>
<metadata_protection_kind>ENCRYPT</metadata_protection_kind>
<data_protection_kind>ENCRYPT</data_protection_kind>
</topic_rule></topic_access_rules>
</domain_rule></domain_access_rules></dds>
"""
_CA_CONFIG = """\
[req]
distinguished_name = name
x509_extensions = ca
prompt = no
[name]
CN = testCA
[ca]
basicConstraints = critical, CA:true, pathlen:1
[node]
basicConstraints = CA:false
"""


@dataclass(frozen=True)
class Rights:
    """DDS topics that an enclave may write and read."""

    publish: frozenset[str] = frozenset()
    subscribe: frozenset[str] = frozenset()

    @property
    def all(self) -> frozenset[str]:
        """Every topic that is named."""
        return self.publish | self.subscribe

    def __or__(self, other: Rights) -> Rights:
        return Rights(self.publish | other.publish, self.subscribe | other.subscribe)


def rights(kind: str, names: Iterable[str]) -> Rights:
    """Rights on topics or services with absolute names; ``kind`` is an attribute of a SROS2 policy."""
    absolute = list(names)
    topics = frozenset(f"rt{name}" for name in absolute)
    requests = frozenset(_REQUEST.format(name) for name in absolute)
    replies = frozenset(_REPLY.format(name) for name in absolute)
    return {
        "publish": Rights(publish=topics),
        "subscribe": Rights(subscribe=topics),
        "request": Rights(publish=requests, subscribe=replies),
        "reply": Rights(publish=replies, subscribe=requests),
    }[kind]


def read_policy(path: Path) -> dict[str, Rights]:
    """Rights of each enclave of a SROS2 policy that only allows: DENY rules are not understood."""
    granted: dict[str, Rights] = {}
    for enclave in ElementTree.parse(path).getroot().iter("enclave"):
        total = Rights()
        for profile in enclave.iter("profile"):
            for expressions in profile:
                names = [_absolute(item.text or "", profile.attrib) for item in expressions]
                for kind, qualifier in expressions.attrib.items():
                    if qualifier != "ALLOW":
                        raise ValueError(f"{kind} is {qualifier} in {enclave.attrib['path']}")
                    total |= rights(kind, names)
        granted[enclave.attrib["path"]] = total
    return granted


def _absolute(name: str, profile: dict[str, str]) -> str:
    namespace = profile["ns"].rstrip("/")
    if name.startswith("/"):
        return name
    if name.startswith("~"):
        return f"{namespace}/{profile['node']}{name[1:]}"
    return f"{namespace}/{name}"


class Keystore:
    """A keystore with one certificate authority.

    Parameters
    ----------
    root
        Folder to make; the value of ROS_SECURITY_KEYSTORE.
    domain_id
        The only ROS domain that it is valid in.
    """

    def __init__(self, root: Path, domain_id: int) -> None:
        self.root = root
        self._domain_id = domain_id
        self._key = root / "private" / "ca.key.pem"
        self._certificate = root / "public" / "ca.cert.pem"
        self._config = root / "private" / "openssl.cnf"
        for folder in ("public", "private", "enclaves"):
            (root / folder).mkdir(parents=True)
        self._config.write_text(_CA_CONFIG, encoding="ascii")
        self._openssl("req", "-x509", *self._new_key(self._key), "-out", self._certificate)
        governance = root / "enclaves" / "governance.xml"
        governance.write_text(_GOVERNANCE.format(domain=domain_id), encoding="ascii")
        self._sign(governance)

    def add(self, enclave: str, granted: Rights) -> None:
        """An enclave such as ``/sem/rectifier`` with its rights."""
        folder = self.root / "enclaves" / enclave.lstrip("/")
        folder.mkdir(parents=True)
        for name in ("identity_ca.cert.pem", "permissions_ca.cert.pem"):
            shutil.copy(self._certificate, folder / name)
        shutil.copy(self.root / "enclaves" / "governance.p7s", folder)
        request = folder / "request.pem"
        # A slash would begin the next part of the name.
        subject = "/CN=" + enclave.replace("/", "\\/")
        key = self._new_key(folder / "key.pem")
        self._openssl("req", "-new", *key, "-subj", subject, "-out", request)
        authority = ("-CA", self._certificate, "-CAkey", self._key, "-CAcreateserial")
        extensions = ("-extfile", self._config, "-extensions", "node")
        certificate = ("-sha256", "-days", "30", "-out", folder / "cert.pem")
        self._openssl("x509", "-req", "-in", request, *authority, *extensions, *certificate)
        permissions = folder / "permissions.xml"
        permissions.write_text(self._permissions(enclave, granted), encoding="ascii")
        self._sign(permissions)

    def _permissions(self, enclave: str, granted: Rights) -> str:
        today = datetime.now().replace(microsecond=0)
        root = ElementTree.Element("dds")
        grant = ElementTree.SubElement(
            ElementTree.SubElement(root, "permissions"), "grant", name=enclave
        )
        ElementTree.SubElement(grant, "subject_name").text = f"CN={enclave}"
        validity = ElementTree.SubElement(grant, "validity")
        for name, days in (("not_before", -2), ("not_after", 30)):
            moment = today + timedelta(days=days)
            ElementTree.SubElement(validity, name).text = moment.isoformat()
        rule = ElementTree.SubElement(grant, "allow_rule")
        domains = ElementTree.SubElement(rule, "domains")
        ElementTree.SubElement(domains, "id").text = str(self._domain_id)
        # Every ROS participant tells the others of its nodes.
        for name, topics in (("publish", granted.publish), ("subscribe", granted.subscribe)):
            listed = ElementTree.SubElement(ElementTree.SubElement(rule, name), "topics")
            for topic in sorted(topics | {_GRAPH}):
                ElementTree.SubElement(listed, "topic").text = topic
        ElementTree.SubElement(grant, "default").text = "DENY"
        return ElementTree.tostring(root, encoding="unicode")

    def _new_key(self, path: Path) -> tuple[str | Path, ...]:
        curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
        return ("-config", self._config, *curve, "-keyout", path)

    def _sign(self, path: Path) -> None:
        signer = ("-signer", self._certificate, "-inkey", self._key)
        target = path.with_suffix(".p7s")
        self._openssl("smime", "-sign", "-text", "-in", path, *signer, "-out", target)

    def _openssl(self, *arguments: str | Path) -> None:
        # The wheels of ROS bring a libcrypto of their own along, which is not that of this program.
        environment = {k: v for k, v in os.environ.items() if k != "LD_LIBRARY_PATH"}
        done = subprocess.run(
            ["openssl", *arguments], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise RuntimeError(f"openssl {arguments[0]}: {done.stderr}")
