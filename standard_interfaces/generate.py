"""Write the .msg, .srv and .action files of interfaces.ini: `generate.py PACKAGE FOLDER`.

Prints the files written, relative to the folder, separated by semicolons (a list of cmake).
"""

import configparser
import sys
from pathlib import Path

PARTS = {
    "msg": ("fields",),
    "srv": ("request", "response"),
    "action": ("goal", "result", "feedback"),
}


def lines(section, part):
    """The lines of one part of a definition: constants, then fields."""
    prefix, _, constants = section.get(f"{part}.constants", "").rpartition(":")
    for constant in filter(None, constants.split(",")):
        name, value = constant.split()
        yield f"uint8 {prefix}{name}={value}"
    for field in filter(None, (text.strip() for text in section[part].split(","))):
        name, kind = field.split()
        kind, _, default = kind.partition("=")
        yield f"{kind} {name} {default}".rstrip()


def main(package, folder):
    """Write the files of a package."""
    table = configparser.ConfigParser()
    table.optionxform = str
    table.read(Path(__file__).with_name("interfaces.ini"), encoding="utf-8")
    written = []
    for name in table.sections():
        owner, kind, interface = name.split("/")
        if owner == package:
            texts = ("".join(f"{line}\n" for line in lines(table[name], p)) for p in PARTS[kind])
            file = Path(folder, kind, f"{interface}.{kind}")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("---\n".join(texts), encoding="utf-8")
            written.append(f"{kind}/{interface}.{kind}")
    print(";".join(written), end="")


if __name__ == "__main__":
    main(*sys.argv[1:])
