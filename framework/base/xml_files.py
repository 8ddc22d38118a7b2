"""Reading of XML files from elsewhere, with errors on one line, and without anything that a DOCTYPE can declare."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from nerfloom.base.errors import DataError


def read_xml(file: Path) -> Element:
    """Read the root element of an XML file.

    Files with a DOCTYPE are refused, because it may declare entities that expand beyond memory or name other files.

    Args:
        file: the file.

    Raises:
        DataError: if the file cannot be read, is not XML, or has a DOCTYPE.
    """

    def refuse(*_: object) -> None:
        raise DataError(f"{file} has a DOCTYPE, which is not read because it may name other files; remove it")

    builder, parser = TreeBuilder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(file.read_bytes(), True)
        return builder.close()
    except DataError:
        raise
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (expat.ExpatError, LookupError, ValueError) as error:  # the last two: an unknown encoding
        raise DataError(f"{file} is not XML: {error}") from error
