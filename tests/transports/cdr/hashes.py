"""Type hashes that ROS 2 Kilted has in the JSON files beside its interface files."""

from __future__ import annotations

HASHES = {
    "arduinobot_msgs/action/Fibonacci": (
        "RIHS01_517475c043edbc1f6f21d50a79a61b7f503e56d7bae1851229af866c0ec961b9"
    ),
    "arduinobot_msgs/action/Fibonacci_Goal": (
        "RIHS01_42deb0d6f24ee7fcdefdef51842b4fb1fa101c10d30b1c85ec1fa68284f8553e"
    ),
    "arduinobot_msgs/action/Fibonacci_Result": (
        "RIHS01_7c6e80f9049e5412c3d99856fa66ff25ac437822039678c8b31668e01a8e1c25"
    ),
    "arduinobot_msgs/action/Fibonacci_Feedback": (
        "RIHS01_bd983edde7e458d2eac7d88856f4d73fca964cb224d917d2295b555190d8826e"
    ),
    "arduinobot_msgs/action/Fibonacci_FeedbackMessage": (
        "RIHS01_604ef4953a4ac339f4d1415a8589910b71e40fe32c0dfce26d2adc7380e341d4"
    ),
    "arduinobot_msgs/action/Fibonacci_SendGoal": (
        "RIHS01_cddb0bdb587c990f2afd7cbc49ceda2f6ed89560becfcce39c3d24b3e58288c0"
    ),
    "arduinobot_msgs/action/Fibonacci_SendGoal_Request": (
        "RIHS01_189adbe9370aa5f07a728a0eb0612068fdb264cf7204d1fe297da65059e9a58e"
    ),
    "arduinobot_msgs/action/Fibonacci_SendGoal_Response": (
        "RIHS01_50a11cd2b61c92a8bb87a969821bd2525b516280f64daaf391477f64ff43fdb2"
    ),
    "arduinobot_msgs/action/Fibonacci_SendGoal_Event": (
        "RIHS01_f404d0dbded3b183c587bc227086c3341b146db50d96b3ea03d42b747aa6203c"
    ),
    "arduinobot_msgs/action/Fibonacci_GetResult": (
        "RIHS01_f5d9da346ffb7be51dcdbba8725d124b6499ef617cdbabb1d8e5737081445ec1"
    ),
    "arduinobot_msgs/action/Fibonacci_GetResult_Request": (
        "RIHS01_0e48e8f3f98de95087e83380fdde49aa0302f35d807411f39438054a603c1143"
    ),
    "arduinobot_msgs/action/Fibonacci_GetResult_Response": (
        "RIHS01_ded124fd7abff27bcb4dabea2588df87882b19d380d064c3341ef415d4093cc6"
    ),
    "action_msgs/srv/CancelGoal": (
        "RIHS01_573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a"
    ),
    "action_msgs/srv/CancelGoal_Request": (
        "RIHS01_3d3c84653c1f96918086887e1dcb236faec88b81a5b14fd4cf4840065bcdf8af"
    ),
    "action_msgs/srv/CancelGoal_Response": (
        "RIHS01_35e682cf3f510e83c70a82a4aac888496dedee56773bf9d8e5e0aa81f9e1c960"
    ),
    "action_msgs/msg/GoalStatusArray": (
        "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"
    ),
    "action_msgs/msg/GoalInfo": (
        "RIHS01_6398fe763154554353930716b225947f93b672f0fb2e49fdd01bb7a7e37933e9"
    ),
    "unique_identifier_msgs/msg/UUID": (
        "RIHS01_1b8e8aca958cbea28fe6ef60bf6c19b683c97a9ef60bb34752067d0f2f7ab437"
    ),
    "builtin_interfaces/msg/Time": (
        "RIHS01_b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197"
    ),
    "rmw_dds_common/msg/ParticipantEntitiesInfo": (
        "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
    ),
    "geometry_msgs/msg/PoseStamped": (
        "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    ),
    "std_msgs/msg/Empty": (
        "RIHS01_20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312"
    ),
    "fibaction_test_msgs/action/Everything_Goal": (
        "RIHS01_efcd49b9262eeb0a4106d37a729550c161f0f4da32771fd6985cf7cd37ff0915"
    ),
    "fibaction_test_msgs/action/Everything_Result": (
        "RIHS01_757134246bd875a9b0eabf15161604c9c29547b7de126bd2091f0f8423005be0"
    ),
    "fibaction_test_msgs/action/Nothing": (
        "RIHS01_dc31125080c69bdf2bebaab69336ee122edfac7fa276f875ac0cdc828b6a60d9"
    ),
}
