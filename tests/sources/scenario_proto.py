"""The oracle for record bytes: WOMD's ``Scenario`` message, described at run time.

protobuf parses and writes by this description; the project itself never does.
"""

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_FIELD = descriptor_pb2.FieldDescriptorProto
_SCALARS = {
    "double": _FIELD.TYPE_DOUBLE,
    "float": _FIELD.TYPE_FLOAT,
    "int32": _FIELD.TYPE_INT32,
    "int64": _FIELD.TYPE_INT64,
    "bool": _FIELD.TYPE_BOOL,
    "string": _FIELD.TYPE_STRING,
}

_MESSAGES = {
    "ObjectState": "center_x=2:double center_y=3:double center_z=4:double length=5:float "
    "width=6:float height=7:float heading=8:float velocity_x=9:float velocity_y=10:float "
    "valid=11:bool",
    "Track": "id=1:int32 object_type=2:int32 states=3:*ObjectState",
    "TrafficSignalLaneState": "lane=1:int64 state=2:int32 stop_point=3:MapPoint",
    "DynamicMapState": "lane_states=1:*TrafficSignalLaneState",
    "MapPoint": "x=1:double y=2:double z=3:double",
    "BoundarySegment": "lane_start_index=1:int32 lane_end_index=2:int32 "
    "boundary_feature_id=3:int64 boundary_type=4:int32",
    "LaneNeighbor": "feature_id=1:int64 self_start_index=2:int32 self_end_index=3:int32 "
    "neighbor_start_index=4:int32 neighbor_end_index=5:int32 boundaries=6:*BoundarySegment",
    "LaneCenter": "speed_limit_mph=1:double type=2:int32 interpolating=3:bool "
    "polyline=8:*MapPoint entry_lanes=9:*int64 exit_lanes=10:*int64 "
    "left_neighbors=11:*LaneNeighbor right_neighbors=12:*LaneNeighbor "
    "left_boundaries=13:*BoundarySegment right_boundaries=14:*BoundarySegment",
    "RoadLine": "type=1:int32 polyline=2:*MapPoint",
    "RoadEdge": "type=1:int32 polyline=2:*MapPoint",
    "StopSign": "lane=1:*int64 position=2:MapPoint",
    "Crosswalk": "polygon=1:*MapPoint",
    "SpeedBump": "polygon=1:*MapPoint",
    "Driveway": "polygon=1:*MapPoint",
    "MapFeature": "id=1:int64 lane=3:LaneCenter road_line=4:RoadLine road_edge=5:RoadEdge "
    "stop_sign=7:StopSign crosswalk=8:Crosswalk speed_bump=9:SpeedBump "
    "driveway=10:Driveway",
    "RequiredPrediction": "track_index=1:int32 difficulty=2:int32",
    "Scenario": "timestamps_seconds=1:*double tracks=2:*Track objects_of_interest=4:*int32 "
    "scenario_id=5:string sdc_track_index=6:int32 dynamic_map_states=7:*DynamicMapState "
    "map_features=8:*MapFeature current_time_index=10:int32 "
    "tracks_to_predict=11:*RequiredPrediction",
}
"""Fields as ``name=number:type``; ``*`` for repeated ones, ``**`` for packed ones."""


def message_class(messages: dict[str, str], wanted: str) -> Any:
    """Build the class of one of several messages."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{wanted}.proto", package="oracle")
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for field in fields.split():
            _add_field(message, field)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"oracle.{wanted}"))


def _add_field(message: Any, text: str) -> None:
    name, rest = text.split("=")
    number, kind = rest.split(":")
    field = message.field.add(name=name, number=int(number))
    repeated = kind.startswith("*")
    field.label = _FIELD.LABEL_REPEATED if repeated else _FIELD.LABEL_OPTIONAL
    if kind.startswith("**"):
        field.options.packed = True
    kind = kind.lstrip("*")
    field.type = _SCALARS.get(kind, _FIELD.TYPE_MESSAGE)
    if kind not in _SCALARS:
        field.type_name = f".oracle.{kind}"


Scenario = message_class(_MESSAGES, "Scenario")
