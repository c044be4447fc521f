// A stock node of rclcpp: it echoes messages, serves and calls a service, and has parameters.

#include <memory>
#include <string>
#include <vector>

#include "geometry_msgs/msg/pose_stamped.hpp"
#include "nav_msgs/msg/odometry.hpp"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"
#include "test_msgs/msg/arrays.hpp"
#include "test_msgs/msg/basic_types.hpp"
#include "test_msgs/msg/unbounded_sequences.hpp"
#include "test_msgs/msg/w_strings.hpp"
#include "test_msgs/srv/basic_types.hpp"
#include "trajectory_msgs/msg/joint_trajectory.hpp"

using BasicTypes = test_msgs::srv::BasicTypes;
using String = std_msgs::msg::String;

class Peer : public rclcpp::Node
{
public:
  Peer() : Node("stock")
  {
    echo<test_msgs::msg::Arrays>("Arrays");
    echo<test_msgs::msg::BasicTypes>("BasicTypes");
    echo<test_msgs::msg::UnboundedSequences>("UnboundedSequences");
    echo<test_msgs::msg::WStrings>("WStrings");
    echo<geometry_msgs::msg::PoseStamped>("PoseStamped");
    echo<nav_msgs::msg::Odometry>("Odometry");
    echo<trajectory_msgs::msg::JointTrajectory>("JointTrajectory");

    map_ = create_publisher<String>("map", rclcpp::QoS(1).transient_local());
    String kept;
    kept.data = "kept";
    map_->publish(kept);

    server_ = create_service<BasicTypes>(
      "served",
      [](const BasicTypes::Request::SharedPtr request, BasicTypes::Response::SharedPtr response) {
        response->int64_value = -request->int64_value;
        response->string_value = request->string_value;
      });
    client_ = create_client<BasicTypes>("asked");
    told_ = create_publisher<String>("told", 10);
    ends_.push_back(create_subscription<String>("ask", 10, [this](const String & text) {
      auto request = std::make_shared<BasicTypes::Request>();
      request->string_value = text.data;
      client_->async_send_request(request, [this](rclcpp::Client<BasicTypes>::SharedFuture future) {
        String answer;
        answer.data = future.get()->string_value;
        told_->publish(answer);
      });
    }));

    rcl_interfaces::msg::ParameterDescriptor speed;
    speed.floating_point_range.resize(1);
    speed.floating_point_range[0].to_value = 2.0;
    declare_parameter("speed", 0.5, speed);
    declare_parameter("names", std::vector<std::string>{"a", "b"});
  }

private:
  template<typename MessageT>
  void echo(const std::string & name)
  {
    auto back = create_publisher<MessageT>("back/" + name, 10);
    ends_.push_back(create_subscription<MessageT>(
      "there/" + name, 10, [back](const MessageT & message) { back->publish(message); }));
  }

  std::vector<std::shared_ptr<void>> ends_;
  rclcpp::Publisher<String>::SharedPtr map_, told_;
  rclcpp::Service<BasicTypes>::SharedPtr server_;
  rclcpp::Client<BasicTypes>::SharedPtr client_;
};

// Called by a process of Python: the wheels' libraries of ROS need those of Python.
extern "C" void run(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Peer>());
  rclcpp::shutdown();
}
