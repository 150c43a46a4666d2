"""The oracle for submissions: Waymo's messages, described at run time."""

from tests.sources.scenario_proto import message_class

_MESSAGES = {
    "SimulatedTrajectory": "center_x=2:**float center_y=3:**float center_z=4:**float "
    "heading=5:**float object_id=6:int32",
    "JointScene": "simulated_trajectories=1:*SimulatedTrajectory",
    "ScenarioRollouts": "scenario_id=1:string joint_scenes=2:*JointScene",
    "SimAgentsChallengeSubmission": "scenario_rollouts=1:*ScenarioRollouts "
    "submission_type=2:int32 account_name=3:string unique_method_name=4:string "
    "authors=5:*string affiliation=6:string description=7:string method_link=8:string "
    "uses_lidar_data=9:bool uses_camera_data=10:bool uses_public_model_pretraining=11:bool "
    "num_model_parameters=12:string public_model_names=13:*string "
    "acknowledge_complies_with_closed_loop_requirement=14:bool",
}

Submission = message_class(_MESSAGES, "SimAgentsChallengeSubmission")
