"""Compares our protobuf definitions with those of the package dm-env-rpc: descriptors.py FILE.

FILE is a FileDescriptorSet with our definitions. Everything that affects the wire format must be equal: packages,
names, numbers, types, oneofs, reserved numbers. Exits with 1 if something differs.
"""

import sys
from pathlib import Path

from dm_env_rpc.v1 import dm_env_rpc_pb2
from dm_env_rpc.v1.extensions import properties_pb2
from google.protobuf import descriptor_pb2
from google.rpc import status_pb2


def main(path: str) -> int:
    """Prints how many files are equal, or the first file that differs. Returns the exit status."""
    ours = {file.name: file for file in descriptor_pb2.FileDescriptorSet.FromString(Path(path).read_bytes()).file}
    for module in (dm_env_rpc_pb2, properties_pb2, status_pb2):
        theirs = descriptor_pb2.FileDescriptorProto()
        module.DESCRIPTOR.CopyToProto(theirs)
        pair = [_wire(theirs), _wire(ours[theirs.name])]
        if pair[0] != pair[1]:
            print(f"{theirs.name} differs.\nTheirs:\n{pair[0]}\nOurs:\n{pair[1]}")
            return 1
    print("3 files are equal")
    return 0


def _wire(file: descriptor_pb2.FileDescriptorProto) -> descriptor_pb2.FileDescriptorProto:
    """Removes everything that does not affect the wire format: comments, options, names for JSON, order."""
    file.ClearField("source_code_info")
    file.ClearField("options")
    for declarations in (file.message_type, file.enum_type):
        declarations.sort(key=lambda declaration: declaration.name)
    for message in file.message_type:
        _strip(message)
    for service in file.service:
        for method in service.method:
            method.ClearField("options")
    return file


def _strip(message: descriptor_pb2.DescriptorProto) -> None:
    message.nested_type.sort(key=lambda nested: nested.name)
    # Adjacent ranges of reserved numbers may be written as a single range, so they are split into single numbers.
    reserved = sorted({number for r in message.reserved_range for number in range(r.start, r.end)})
    message.ClearField("reserved_range")
    for number in reserved:
        message.reserved_range.add(start=number, end=number + 1)
    for field in message.field:
        field.ClearField("json_name")
    for nested in message.nested_type:
        _strip(nested)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
