"""The few shapes of elements that Fast DDS profiles are made of.

Owns: text elements and locators, as Fast DDS 2.14's XML parser reads them. Must not import rclpy.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET


def child(parent: ET.Element, tag: str) -> ET.Element:
    """Return the first child of this name; made if there is none."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def text(parent: ET.Element, tag: str, content: str) -> None:
    """Add a child with text."""
    ET.SubElement(parent, tag).text = content


def locator(parent: ET.Element, kind: str, address: str, port: int | None) -> None:
    """Add a UDP locator to a list.

    Args:
        parent: the list.
        kind: "udpv4" or "udpv6".
        address: empty for any.
        port: None for the well-known one.
    """
    element = ET.SubElement(ET.SubElement(parent, "locator"), kind)
    if address:
        text(element, "address", address)
    if port is not None:
        text(element, "port", str(port))


def tcp_locator(
    parent: ET.Element, address: str, physical: int | None, logical: int | None
) -> None:
    """Add a TCP locator over IPv4 to a list.

    Args:
        parent: the list.
        address: empty for any.
        physical: the port that is listened on; None for the transport's.
        logical: the port inside the connection, which Fast DDS tells traffic apart by; None for
            the well-known ones.
    """
    element = ET.SubElement(ET.SubElement(parent, "locator"), "tcpv4")
    if address:
        text(element, "address", address)
    if physical is not None:
        text(element, "physical_port", str(physical))
    if logical is not None:
        text(element, "port", str(logical))
