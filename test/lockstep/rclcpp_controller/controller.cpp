// Copyright 2026 The diffdrive_jacobian developers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

// Drives to the goal in a timer, with a parameter and a service. It knows nothing of lockstep.
#include <cmath>
#include <geometry_msgs/msg/pose_stamped.hpp>
#include <geometry_msgs/msg/twist.hpp>
#include <memory>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_srvs/srv/trigger.hpp>

using geometry_msgs::msg::PoseStamped;
using geometry_msgs::msg::Twist;
using nav_msgs::msg::Odometry;
using std_srvs::srv::Trigger;

class Controller : public rclcpp::Node
{
public:
  Controller() : Node("controller")
  {
    declare_parameter("kp", 1.0);
    commands_ = create_publisher<Twist>("cmd_vel", 10);
    odometry_ = create_subscription<Odometry>(
      "odom", 10, [this](Odometry::ConstSharedPtr message) {last_ = message;});
    goals_ = create_subscription<PoseStamped>(
      "goal_pose", 10, [this](PoseStamped::ConstSharedPtr message) {goal_ = message;});
    cancel_ = create_service<Trigger>(
      "cancel", [this](Trigger::Request::SharedPtr, Trigger::Response::SharedPtr response) {
        response->success = goal_ != nullptr;
        goal_.reset();
        commands_->publish(Twist());
      });
    timer_ = rclcpp::create_timer(
      this, get_clock(), rclcpp::Duration::from_seconds(0.02), [this]() {drive();});
  }

private:
  void drive()
  {
    if (!last_ || !goal_) {
      return;
    }
    const auto & pose = last_->pose.pose;
    const double x = goal_->pose.position.x - pose.position.x;
    const double y = goal_->pose.position.y - pose.position.y;
    const double heading = 2.0 * std::atan2(pose.orientation.z, pose.orientation.w);
    const double error = std::remainder(std::atan2(y, x) - heading, 2.0 * M_PI);
    Twist command;
    command.linear.x = get_parameter("kp").as_double() * std::hypot(x, y) * std::cos(error);
    command.angular.z = 3.0 * error;
    commands_->publish(command);
  }

  Odometry::ConstSharedPtr last_;
  PoseStamped::ConstSharedPtr goal_;
  rclcpp::Publisher<Twist>::SharedPtr commands_;
  rclcpp::Subscription<Odometry>::SharedPtr odometry_;
  rclcpp::Subscription<PoseStamped>::SharedPtr goals_;
  rclcpp::Service<Trigger>::SharedPtr cancel_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Controller>());
  rclcpp::shutdown();
}
