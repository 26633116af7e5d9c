"""Content models of a digital calibration certificate, transcribed from its published documentation.

Source: the schema reference of PTB for version 3.2.1 (https://ptb.de/dcc) with D-SI 2.1.0 (https://ptb.de/si).
Only what a certificate of this package may use stands here; anything else is refused. `judge` walks a
document element by element: names and namespaces, order, number, attributes, and the form of each value.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
MANY = 10**9

NOT_EMPTY = r"[^\s]+(\s+[^\s]+)*"
DECIMAL = r"[-+]?((\d*\.\d+)|(\d+\.\d*)|(\d+\.?))([Ee][-+]?\d+)?"
POSITIVE = r"\+?((\d*\.\d+)|(\d+\.\d*)|(\d+\.?))([Ee][-+]?\d+)?"
FACTOR = r"\+?(([1-9]\d*\.\d*)|([1-9]\d*))"
PROBABILITY = r"\+?((0(\.\d*)?)|(1(\.0*)?))"
DATE = r"\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])"
CONFORMITY = "pass|fail|conditionalPass|conditionalFail|noPass|noFail"
PLACES = "laboratory|customer|laboratoryBranch|customerBranch|other"
ISSUERS = "manufacturer|calibrationLaboratory|customer|owner|other"
KINDS = "application|bios|driver|editor|firmware|library|os|other"


def listed(pattern: str) -> str:
    """Values of a pattern with blanks between them."""
    return rf"({pattern})( ({pattern}))*"


# Type → its children in order (name, type, least, most); a string is the pattern of a value.
TYPES: dict[str, list[tuple[str, str, int, int]] | str] = {
    "certificate": [
        (f"{DCC}administrativeData", "administrative", 1, 1),
        (f"{DCC}measurementResults", "results", 1, 1),
    ],
    "administrative": [
        (f"{DCC}dccSoftware", "softwares", 1, 1),
        (f"{DCC}coreData", "core", 1, 1),
        (f"{DCC}items", "items", 1, 1),
        (f"{DCC}calibrationLaboratory", "laboratory", 1, 1),
        (f"{DCC}respPersons", "persons", 1, 1),
        (f"{DCC}customer", "contact", 1, 1),
        (f"{DCC}statements", "statements", 0, 1),
    ],
    "softwares": [(f"{DCC}software", "software", 1, MANY)],
    "software": [
        (f"{DCC}name", "text", 1, 1),
        (f"{DCC}release", NOT_EMPTY, 1, 1),
        (f"{DCC}type", KINDS, 0, 1),
    ],
    "core": [
        (f"{DCC}countryCodeISO3166_1", "[A-Z]{2}", 1, 1),
        (f"{DCC}usedLangCodeISO639_1", "[a-z]{2}", 1, MANY),
        (f"{DCC}mandatoryLangCodeISO639_1", "[a-z]{2}", 1, MANY),
        (f"{DCC}uniqueIdentifier", NOT_EMPTY, 1, 1),
        (f"{DCC}beginPerformanceDate", DATE, 1, 1),
        (f"{DCC}endPerformanceDate", DATE, 1, 1),
        (f"{DCC}performanceLocation", PLACES, 1, 1),
    ],
    "items": [(f"{DCC}item", "item", 1, MANY)],
    "item": [
        (f"{DCC}name", "text", 1, 1),
        (f"{DCC}manufacturer", "person", 0, 1),
        (f"{DCC}model", NOT_EMPTY, 0, 1),
        (f"{DCC}identifications", "identifications", 1, 1),
    ],
    "identifications": [(f"{DCC}identification", "identification", 1, MANY)],
    "identification": [
        (f"{DCC}issuer", ISSUERS, 1, 1),
        (f"{DCC}value", NOT_EMPTY, 1, 1),
        (f"{DCC}name", "text", 0, 1),
    ],
    "laboratory": [(f"{DCC}contact", "contact", 1, 1)],
    "contact": [(f"{DCC}name", "text", 1, 1), (f"{DCC}location", "location", 1, 1)],
    "location": [(f"{DCC}further", "rich", 1, MANY)],
    "persons": [(f"{DCC}respPerson", "responsible", 1, MANY)],
    "responsible": [(f"{DCC}person", "person", 1, 1)],
    "person": [(f"{DCC}name", "text", 1, 1)],
    "statements": [(f"{DCC}statement", "statement", 1, MANY)],
    "statement": [(f"{DCC}declaration", "rich", 0, 1), (f"{DCC}conformity", CONFORMITY, 0, 1)],
    "results": [(f"{DCC}measurementResult", "measurement", 1, MANY)],
    "measurement": [
        (f"{DCC}name", "text", 1, 1),
        (f"{DCC}usedMethods", "methods", 0, 1),
        (f"{DCC}usedSoftware", "softwares", 0, 1),
        (f"{DCC}measuringEquipments", "equipments", 0, 1),
        (f"{DCC}influenceConditions", "conditions", 0, 1),
        (f"{DCC}results", "result list", 1, 1),
    ],
    "methods": [(f"{DCC}usedMethod", "method", 1, MANY)],
    "method": [(f"{DCC}name", "text", 1, 1), (f"{DCC}description", "rich", 0, 1)],
    "equipments": [(f"{DCC}measuringEquipment", "person", 1, MANY)],
    "conditions": [(f"{DCC}influenceCondition", "result", 1, MANY)],
    "result list": [(f"{DCC}result", "result", 1, MANY)],
    "result": [(f"{DCC}name", "text", 1, 1), (f"{DCC}data", "data", 1, 1)],
    "data": [(f"{DCC}quantity", "quantity", 1, MANY)],
    "quantity": [
        (f"{DCC}name", "text", 0, 1),
        (f"{SI}real", "real", 0, 1),
        (f"{SI}realListXMLList", "real list", 0, 1),
    ],
    "real": [
        (f"{SI}value", DECIMAL, 1, 1),
        (f"{SI}unit", NOT_EMPTY, 1, 1),
        (f"{SI}expandedUnc", "expanded", 0, 1),
    ],
    "expanded": [
        (f"{SI}uncertainty", POSITIVE, 1, 1),
        (f"{SI}coverageFactor", FACTOR, 1, 1),
        (f"{SI}coverageProbability", PROBABILITY, 1, 1),
        (f"{SI}distribution", NOT_EMPTY, 0, 1),
    ],
    "real list": [
        (f"{SI}valueXMLList", listed(DECIMAL), 1, 1),
        (f"{SI}unitXMLList", listed(r"\S+"), 1, 1),
        (f"{SI}expandedUncXMLList", "expanded list", 0, 1),
    ],
    "expanded list": [
        (f"{SI}uncertaintyXMLList", listed(POSITIVE), 1, 1),
        (f"{SI}coverageFactorXMLList", listed(FACTOR), 1, 1),
        (f"{SI}coverageProbabilityXMLList", listed(PROBABILITY), 1, 1),
        (f"{SI}distributionXMLList", listed(r"\S+"), 0, 1),
    ],
    "text": [(f"{DCC}content", r"[\s\S]+", 1, MANY)],
    "rich": [(f"{DCC}content", r"[\s\S]+", 1, MANY)],
}
UNITS = r"(\\(milli|micro|kilo)?(one|degree|metre|second|kelvin|volt|degreecelsius)(\\tothe\{-?\d+\})?)+"
SCHEMA_LOCATION = "{http://www.w3.org/2001/XMLSchema-instance}schemaLocation"


def judge(document: str) -> ET.Element:
    """The root of a certificate; `AssertionError` names the first element that is not as documented."""
    root = ET.fromstring(document)
    assert root.tag == f"{DCC}digitalCalibrationCertificate"
    assert root.attrib.pop("schemaVersion") == "3.2.1"
    assert root.attrib.pop(SCHEMA_LOCATION) == "https://ptb.de/dcc https://ptb.de/dcc/v3.2.1/dcc.xsd"
    _judge(root, "certificate", "")
    for quantity in root.iter(f"{DCC}quantity"):
        assert len([child for child in quantity if child.tag.startswith(SI)]) == 1
    for unit in root.iter(f"{SI}unit"):
        assert re.fullmatch(UNITS, unit.text), unit.text
    return root


def _judge(element: ET.Element, kind: str, path: str) -> None:
    path = f"{path}/{element.tag.partition('}')[2]}"
    assert not element.attrib, path
    model = TYPES.get(kind, kind)
    if isinstance(model, str):
        assert len(element) == 0, path
        assert re.fullmatch(model, element.text or ""), f"{path}: {element.text!r}"
        return
    assert not (element.text or "").strip(), path
    children = list(element)
    for name, child_kind, least, most in model:
        count = 0
        while children and children[0].tag == name:
            _judge(children.pop(0), child_kind, path)
            count += 1
        assert least <= count <= most, f"{path}: {count} times {name}"
    assert not children, f"{path}: {children[0].tag} is out of place"
